"""Fault-tolerant action: the controller's gains rescheduled from the diagnosed parameter, tracking with and without."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.diagnosis.diagnose import diagnose
from servoscope.learning.learn import learn_baseline
from servoscope.models.discretise import discretise
from servoscope.models.loop import Controller, Loop
from servoscope.models.plants import Plant
from servoscope.research.paper.conditions import FAULT_AT, PAPER, FaultCase, default_loop
from servoscope.research.paper.method import EvaluatorResult, FaultManager
from servoscope.research.paper.tracking import TUNING_SEED_OFFSET
from servoscope.signals import Recording
from servoscope.simulation import closed_loop_poles, simulate_response
from servoscope.simulation.measurement import NOISE_U_STD, NOISE_Y_STD, draw_noise
from servoscope.simulation.stability import require_controller

CASES = (FaultCase("p_s", 0.6), FaultCase("beta", 0.005))
DIAGNOSIS_DELAY_S = 5.0  # s between the alarm and the diagnosis that the manager acts on
GAINS = np.geomspace(0.1, 4.0, 60)  # relative to the present k_p
INTEGRALS = (0.5, 1.0, 2.0, 4.0)  # relative to the present k_i
EVALUATION_SPAN_S = (50.0, 60.0)  # s over which tracking is judged


@dataclass(frozen=True, eq=False)
class ReschedulingResult:
    """One fault with and without action."""

    at_s: float | None  # when the gains changed; None: never
    t: FloatArray  # t, r: times [s] and reference [m], shape (N,)
    r: FloatArray
    y_without_action: FloatArray  # idle, acted: output [m] without and with the action, shape (N,)
    y_with_action: FloatArray

    def rms_error(self, y: FloatArray, span: tuple[float, float] = EVALUATION_SPAN_S) -> float:
        """Return the root mean square of the tracking error [m] over a span of time."""
        kept = (self.t >= span[0]) & (self.t < span[1])
        return float(np.sqrt(np.mean((self.r - y)[kept] ** 2)))


def reschedule_gains(loop: Loop, plant: Plant) -> Controller:
    """Return the PI gains that make the loop with a plant, as it is estimated to be, move most like the healthy loop.

    Of a grid of gains around the present ones, those count that leave the loop stable; the output under the paper's
    reference is compared. A change of the flow gain alone is made up for exactly, by the inverse change of k_p.
    """
    present = require_controller(loop)
    r = PAPER.reference_signal()[:1000]
    wanted = simulate_response(loop, r)[1]
    best, controller = np.inf, present
    for gain in GAINS:
        for integral in INTEGRALS:
            tried = Controller(kind="pi", k_p=present.k_p * gain, k_i=present.k_i * integral * gain)
            with_it = loop.model_copy(update={"controller": tried, "plant": plant})
            if np.abs(closed_loop_poles(with_it)).max() >= 1.0:
                continue
            error = float(np.mean((wanted - simulate_response(with_it, r)[1]) ** 2))
            if error < best:
                best, controller = error, tried
    return controller


def simulate_gain_change(
    loop: Loop, case: FaultCase, seed: int, change: tuple[float, Controller] | None = None
) -> Recording:
    """Simulate the loop with a fault at 30 s, and with other gains from a time on.

    The integrator's output carries over. Slow and plain, because gains do not change in `servoscope.simulation`;
    without a change both agree.
    """
    T = 1.0 / loop.sample_rate
    r = PAPER.reference_signal()
    n_u, n_y = draw_noise(r.size, NOISE_U_STD, NOISE_Y_STD, seed)
    fault_plant = loop.plant.with_ratios({case.parameter: case.ratio})
    healthy, faulty = (
        discretise(plant.state_space(), loop.sample_rate, hold="zoh") for plant in (loop.plant, fault_plant)
    )
    present = require_controller(loop)
    k_p, integrating = present.k_p, present.k_i / loop.sample_rate
    total = 0.0
    x = np.zeros(len(healthy.c))
    u, y = np.empty(r.size), np.empty(r.size)
    for k in range(r.size):
        if change is not None and k == round(change[0] / T):
            k_p, integrating = change[1].k_p, change[1].k_i * T
        y[k] = float(healthy.c @ x) + n_y[k]
        e = r[k] - y[k]
        total += integrating * e
        u[k] = k_p * e + total
        now = healthy if k < round(FAULT_AT / T) else faulty
        x = now.A @ x + now.b_now * (u[k] + n_u[k])
    restart = np.arange(r.size) == 0
    t = np.asarray(np.arange(r.size) * T, dtype=np.float64)
    return Recording(
        t, r, u, y, restart, name=loop.name, sample_rate=loop.sample_rate, run=np.zeros(r.size, dtype=np.int32)
    )


@functools.lru_cache(maxsize=4)
def evaluate_rescheduling(case: FaultCase, seed: int) -> ReschedulingResult:
    """Let a fault happen, diagnose it from what was recorded until then, reschedule, and go on."""
    loop = default_loop()
    baseline = learn_baseline(loop, [PAPER.simulate(loop, seed + TUNING_SEED_OFFSET)])
    idle = simulate_gain_change(loop, case, seed)
    at, acted, diagnosis = None, idle, diagnose(baseline, idle)
    if diagnosis.detected_at_s is not None:
        known_until = diagnosis.detected_at_s + DIAGNOSIS_DELAY_S
        diagnosis = diagnose(baseline, idle.part(0.0, known_until))
        for fault in diagnosis.faults[:1]:
            finding = EvaluatorResult(diagnosis.detected_at_s, fault.name, fault.ratio)
            if FaultManager().decide(finding) == "reconfigure":
                at, ill = known_until, loop.plant.with_ratios({fault.parameter: fault.ratio})
                acted = simulate_gain_change(loop, case, seed, (at, reschedule_gains(loop, ill)))
    return ReschedulingResult(at, idle.t, idle.r, idle.y, acted.y)


def tolerance_metrics(seed: int) -> dict[str, float]:
    """Return tracking errors [m] before the fault, after it without action, and with it."""
    metrics: dict[str, float] = {}
    for case in CASES:
        result = evaluate_rescheduling(case, seed)
        name = f"tolerance.{case.fault}"
        metrics |= {
            f"{name}.before": result.rms_error(result.y_without_action, (20.0, 30.0)),
            f"{name}.idle": result.rms_error(result.y_without_action),
            f"{name}.acted": result.rms_error(result.y_with_action),
            f"{name}.at": float("nan") if result.at_s is None else result.at_s - FAULT_AT,
        }
    return metrics
