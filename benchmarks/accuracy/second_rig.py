"""A second rig, stiffer and less damped than the reference rig, whose resonance is within what its samples show."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np

import servoscope as ss
from accuracy.draws import PARAMETERS, SECONDS, TABLE_2, between
from accuracy.rig import FAULT_AT, SEEDS_PER_UNIT, loop
from accuracy.scenario import Numbers, Row, Scenario, Table
from accuracy.told import baseline_rows, told
from servoscope.baseline.expectation import Expectation, reference_path
from servoscope.core.arrays import FloatArray
from servoscope.core.errors import SimulationError
from servoscope.estimation.filter_bank import nominal_theta
from servoscope.estimation.noise_model import largest_autocorrelation
from servoscope.isolation.ml.window import ChangeProfile, RefitWindow
from servoscope.simulation import FaultEvent, reference

RATE = 200.0  # Hz
# the load swings twice as fast with half the damping; the oil's resonance, at 143 Hz on the reference rig, is at 76 Hz
PLANT = {"m_p": 1.0, "b_p": 50.0, "V_o": 16e-4}
KIND = "multisine"
RUNS, UNITS = 10, 20
LAGS = 20
WHITE = 3.0  # standard deviations of an autocorrelation


@functools.cache
def second_loop() -> ss.Loop:
    """Return the loop of the second rig."""
    settings = loop().to_dict()
    return ss.Loop.from_dict(settings | {"name": "second rig", "sample_rate": RATE, "plant": settings["plant"] | PLANT})


def record(unit: int, index: int, faults: tuple[FaultEvent, ...] = ()) -> ss.Recording:
    """Simulate it; unit and index make a seed of their own."""
    r = reference(KIND, SECONDS, RATE)
    return ss.simulate(second_loop(), r, faults=faults, seed=SEEDS_PER_UNIT * unit + index)[0]


def job(seed: int, runs: int = RUNS) -> Numbers:
    """Learn from one healthy recording, and diagnose faults drawn from the ranges of Table 2."""
    healthy, rng = record(seed, 0), np.random.default_rng(seed)
    learned, said = ss.learn(second_loop(), [healthy]), []
    refits = learned.exact is not None and learned.exact.misfit <= 1.0
    for i in range(runs if refits else 0):
        parameter, ratio = drawn(rng)
        fault = FaultEvent(parameter, ratio, FAULT_AT)
        said.append(told(learned, record(seed, 1 + i, (fault,)), [fault]))
    off = {name: [float(np.log(ratio)), learned.healthy.std[name]] for name, ratio in learned.healthy.ratios.items()}
    return {
        "runs": said,
        "of": runs,
        "healthy": off,
        "sequential": bool(learned.thresholds.hypotheses),
        "whiteness": [largest(e) for e in (innovations(learned, healthy), residual(learned, healthy))],
    }


def drawn(rng: np.random.Generator) -> tuple[str, float]:
    """Draw a parameter and a ratio, log-uniform, under which the loop is stable."""
    while True:
        parameter = PARAMETERS[int(rng.integers(len(PARAMETERS)))]
        ratio = between(rng, *TABLE_2[parameter])
        try:
            event = FaultEvent(parameter, ratio, 0.0)
            ss.simulate(second_loop(), np.zeros(round(SECONDS * RATE)), faults=(event,))
        except SimulationError:
            continue
        return parameter, ratio


def innovations(learned: ss.Baseline, recording: ss.Recording) -> FloatArray:
    """Return the innovations of the exact predictor with plant and noise as learned."""
    window = RefitWindow.from_recording(learned, recording, 0, recording.samples)
    return np.asarray(window.innovations(window.healthy, ChangeProfile(window.samples)), dtype=np.float64)


def residual(learned: ss.Baseline, recording: ss.Recording) -> FloatArray:
    """Return the recursion's residual behind its whitening, without what the reference makes of it."""
    pipeline = learned.pipeline()
    g = pipeline.regression(recording.r, recording.u, recording.y, recording.restart)
    assert learned.healthy.noise is not None, "a loop that can be simulated has its noise split"
    expected = Expectation(pipeline, learned.tuning, learned.healthy.noise, reference_path(recording))
    theta = nominal_theta(learned.loop, learned.plant)
    v = (g.eta - g.phi @ theta)[g.ok] - expected.mean_residual(learned.plant, theta, g.ok)
    return np.asarray(learned.tuning.noise.whiten(v)[round(2.0 * RATE) :])


def largest(e: FloatArray) -> float:
    """Return the largest autocorrelation [standard deviations]."""
    return float(f"{largest_autocorrelation(e, LAGS) * np.sqrt(len(e)):.4g}")


def parameters(words: str, found: Sequence[Numbers]) -> list[Row]:
    """Show the errors of the healthy parameters against what is stated, and how white is what is left."""
    rows = []
    for name in found[0]["healthy"]:
        off, std = np.array([unit["healthy"][name] for unit in found]).T
        error = off.std(ddof=1) / np.sqrt(len(off)) if len(off) > 1 else np.nan
        cells = (f"{off.mean():.4f} ± {error:.4f}", f"{np.sqrt((off**2).mean()):.4f}", f"{std.mean():.4f}")
        rows.append((words, name, *cells, "", ""))
    white = np.array([unit["whiteness"] for unit in found])
    marks = ["**" if np.median(column) > WHITE else "" for column in white.T]
    cells = tuple(f"{m}{np.median(c):.1f}, {c.max():.1f}{m}" for m, c in zip(marks, white.T, strict=True))
    return [*rows, (words, "all", "", "", "", *cells)]


_SCENARIO = Scenario(f"second-rig/{KIND}", KIND, UNITS, job, (), functools.partial(baseline_rows, target=0.99))
TABLES = (
    Table(
        "second-rig",
        (
            *("reference", "baselines, faults", "with a refit", "with a sequential test"),
            *("detected", "named (99)", "not named, what was said", "size in interval (92 to 98)"),
        ),
        (_SCENARIO,),
    ),
    Table(
        "second-rig-healthy",
        (
            *("reference", "parameter", "mean error of its logarithm", "rms", "stated"),
            *("whiteness of innovations: median, largest [standard deviations]", "of the recursion's residual"),
        ),
        (Scenario(_SCENARIO.id, KIND, UNITS, job, (), parameters),),
    ),
)
