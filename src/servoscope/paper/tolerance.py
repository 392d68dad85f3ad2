"""Fault-tolerant action: the controller's gains rescheduled from the diagnosed parameter, tracking with and without."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from servoscope.learning import learn
from servoscope.loop import Controller, Loop
from servoscope.monitor import diagnose
from servoscope.paper.conditions import FAULT_AT, PAPER, Case, default_loop
from servoscope.paper.method import FaultManager, Finding
from servoscope.paper.tracking import COMMISSIONING
from servoscope.plants import FloatArray, Plant
from servoscope.recording import Recording
from servoscope.simulation import closed_loop_poles, response
from servoscope.simulation.closed_loop import NOISE_U_STD, NOISE_Y_STD
from servoscope.simulation.discretise import discretise
from servoscope.simulation.stability import gains

CASES = (Case("p_s", 0.6), Case("beta", 0.005))
GATHER = 5.0  # s between the alarm and the diagnosis that the manager acts on
GAINS = np.geomspace(0.1, 4.0, 60)  # relative to the present k_p
INTEGRALS = (0.5, 1.0, 2.0, 4.0)  # relative to the present k_i
SETTLED = (50.0, 60.0)  # s over which tracking is judged


@dataclass(frozen=True, eq=False)
class Story:
    """One fault with and without action.

    Parameters
    ----------
    case
        What happened.
    fault, ratio
        What the diagnosis said; None: nothing that could be acted on.
    at_s
        When the gains changed; None: never.
    controller
        k_p and k_i after the change.
    t, r
        Times [s] and reference [m], shape (N,).
    idle, acted
        Output [m] without and with the action, shape (N,).
    """

    case: Case
    fault: str | None
    ratio: float | None
    at_s: float | None
    controller: tuple[float, float]
    t: FloatArray
    r: FloatArray
    idle: FloatArray
    acted: FloatArray

    def error(self, y: FloatArray, span: tuple[float, float] = SETTLED) -> float:
        """Return the root mean square of the tracking error [m] over a span of time."""
        kept = (self.t >= span[0]) & (self.t < span[1])
        return float(np.sqrt(np.mean((self.r - y)[kept] ** 2)))


def reschedule(loop: Loop, plant: Plant) -> Controller:
    """Return the PI gains that make the loop with a plant, as it is estimated to be, move most like the healthy loop.

    Of a grid of gains around the present ones, those count that leave the loop stable; the output under the paper's
    reference is compared. A change of the flow gain alone is made up for exactly, by the inverse change of k_p.

    Raises
    ------
    SimulationError
        If the loop has no controller.
    """
    k_p, integrating = gains(loop)
    k_i = integrating * loop.sample_rate
    r = PAPER.r()[:1000]
    wanted = response(loop, r)[1]
    best, found = np.inf, Controller(kind="pi", k_p=k_p, k_i=k_i)
    for gain in GAINS:
        for integral in INTEGRALS:
            tried = Controller(kind="pi", k_p=k_p * gain, k_i=k_i * integral * gain)
            with_it = loop.model_copy(update={"controller": tried, "plant": plant})
            if np.abs(closed_loop_poles(with_it)).max() >= 1.0:
                continue
            error = float(np.mean((wanted - response(with_it, r)[1]) ** 2))
            if error < best:
                best, found = error, tried
    return found


def run(loop: Loop, case: Case, seed: int, change: tuple[float, Controller] | None = None) -> Recording:
    """Simulate the loop with a fault at 30 s, and with other gains from a time on.

    The integrator's output carries over. Slow and plain, because gains do not change in `servoscope.simulation`;
    without a change both agree.

    Raises
    ------
    SimulationError
        If the loop has no controller.
    """
    T = 1.0 / loop.sample_rate
    r = PAPER.r()
    rng = np.random.default_rng(seed)
    n_u = NOISE_U_STD * rng.standard_normal(r.size)
    n_y = NOISE_Y_STD * rng.standard_normal(r.size)
    ill = loop.plant.with_ratios({case.parameter: case.ratio})
    healthy, faulty = (discretise(plant.state_space(), loop.sample_rate, hold="zoh") for plant in (loop.plant, ill))
    k_p, integrating = gains(loop)
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
    return Recording(loop.name, t, r, u, y, loop.sample_rate, restart, np.zeros(r.size, dtype=np.int32), ())


@functools.lru_cache(maxsize=4)
def story(case: Case, seed: int) -> Story:
    """Let a fault happen, diagnose it from what was recorded until then, reschedule, and go on."""
    loop = default_loop()
    baseline = learn(loop, [PAPER.record(loop, seed + COMMISSIONING)])
    idle = run(loop, case, seed)
    said = diagnose(baseline, idle)
    k_p, integrating = gains(loop)
    old = (k_p, integrating * loop.sample_rate)
    untouched = Story(case, None, None, None, old, idle.t, idle.r, idle.y, idle.y)
    if said.detected_at_s is None:
        return untouched
    at = said.detected_at_s + GATHER
    said = diagnose(baseline, idle.part(0.0, at))  # only what was known then
    if not said.faults:
        return untouched
    fault = said.faults[0]
    finding = Finding(said.detected_at_s, fault.name, fault.ratio)
    if FaultManager().decide(finding) != "reconfigure":
        return Story(case, fault.name, fault.ratio, None, old, idle.t, idle.r, idle.y, idle.y)
    controller = reschedule(loop, loop.plant.with_ratios({fault.parameter: fault.ratio}))
    acted = run(loop, case, seed, (at, controller))
    new = (controller.k_p, controller.k_i)
    return Story(case, fault.name, fault.ratio, at, new, idle.t, idle.r, idle.y, acted.y)


def measure(seed: int) -> dict[str, float]:
    """Return tracking errors [m] before the fault, after it without action, and with it."""
    found: dict[str, float] = {}
    for case in CASES:
        told = story(case, seed)
        name = f"tolerance.{case.fault}"
        found[f"{name}.before"] = told.error(told.idle, (20.0, 30.0))
        found[f"{name}.idle"], found[f"{name}.acted"] = told.error(told.idle), told.error(told.acted)
        found[f"{name}.at"] = float("nan") if told.at_s is None else told.at_s - FAULT_AT
        found[f"{name}.ratio"] = float("nan") if told.ratio is None else told.ratio
        found[f"{name}.k_p"], found[f"{name}.k_i"] = told.controller
    return found
