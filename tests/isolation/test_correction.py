"""What estimates mean: the iFRF that a diagnosis reports is that of the true plant, and its ellipses hold it."""

from __future__ import annotations

import functools
from pathlib import Path

import naive
import numpy as np
import pytest
from scipy import stats

from servoscope.baseline.baseline import Baseline
from servoscope.diagnosis.diagnose import diagnose_with_trace
from servoscope.estimation.filter_bank import nominal_theta
from servoscope.learning.learn import learn_baseline
from servoscope.models.loop import Loop
from servoscope.models.plants import Plant
from servoscope.signals import Recording
from servoscope.simulation import FaultEvent, reference, simulate

FREQUENCIES = (1.0, 10.0, 20.0)
LARGEST = (0.005, 0.01, 0.02)  # relative bias of the iFRF at 1, 10 and 20 Hz
SEEDS = 4
LATE = slice(-100, None)  # evaluations of the last 10 s


@functools.cache
def loop() -> Loop:
    return Loop.load(Path(__file__).parents[2] / "src/servoscope/simulation/reference-rig.toml")


def recorded(seed: int, seconds: float = 60.0, *faults: FaultEvent) -> Recording:
    return simulate(loop(), reference("multisine", seconds, 100.0), faults=faults, seed=seed)[0]


@functools.cache
def learned(seed: int, seconds: float = 60.0) -> Baseline:
    return learn_baseline(loop(), [recorded(1000 + seed, seconds)])


def error(H: naive.Array, plant: Plant) -> naive.Array:
    truth = np.array([plant.frequency_response(f) for f in FREQUENCIES])
    return np.asarray(np.abs(H / truth - 1.0))


@pytest.mark.parametrize(
    ("parameter", "ratio"), [("beta", 1.0), ("b_p", 40.0), ("beta", 0.1), ("beta", 0.005)], ids=str
)
@pytest.mark.slow
def test_ifrf_is_that_of_the_actuator(parameter: str, ratio: float) -> None:
    """The mean over the last 10 s and a few seeds, half a minute after the change."""
    plant = loop().plant.with_ratios({parameter: ratio})
    faults = () if ratio == 1.0 else (FaultEvent(parameter, ratio, 30.0),)
    told, raw = [], []
    for seed in range(SEEDS):
        baseline, recording = learned(seed), recorded(seed, 60.0, *faults)
        diagnosis, trace = diagnose_with_trace(baseline, recording)
        assert diagnosis.verdict == ("fault" if faults else "healthy")
        told.append(trace.ifrf.H[LATE].mean(axis=0))
        pipeline = baseline.pipeline()
        raw.append(
            pipeline.bank.E(FREQUENCIES) @ pipeline.estimate(baseline.tuning, recording).theta[LATE].mean(axis=0)
        )
    assert np.all(error(np.mean(told, axis=0), plant) <= LARGEST), error(np.mean(told, axis=0), plant)
    if (parameter, ratio) == ("beta", 0.1):  # so much is taken out
        assert error(np.mean(raw, axis=0), plant)[2] > 0.1


@pytest.mark.slow
def test_standard_deviations_hold_before_and_after_a_change() -> None:
    """All along a trace whose bias comes from its last evaluation; 18 s are a few memories only, hence the margin."""
    ill = loop().plant.with_ratios({"C_ie": 1.2})
    before, after = [], []
    for seed in range(SEEDS):
        _, trace = diagnose_with_trace(learned(0, 600.0), recorded(300 + seed, 60.0, FaultEvent("C_ie", 1.2, 30.0)))
        std = np.sqrt(np.diagonal(trace.covariance, axis1=1, axis2=2))
        for found, plant, (begins, ends) in ((before, loop().plant, (10.0, 28.0)), (after, ill, (40.0, 58.0))):
            off = (trace.theta - nominal_theta(loop(), plant)) / std
            found.append(off[(trace.t > begins) & (trace.t < ends)])
    for found in (before, after):
        rms = np.sqrt(np.mean(np.concatenate(found) ** 2, axis=0))
        assert np.all((rms > 0.5) & (rms < 1.8)), rms


def test_ellipses_hold_the_truth_in_95_of_100_recordings() -> None:
    """Of sixty healthy recordings after one baseline of ten minutes; as many as chance of one in a thousand allows."""
    baseline, count = learned(0, 600.0), 60
    truth = np.array([loop().plant.frequency_response(f) for f in FREQUENCIES])
    inside = np.zeros(len(FREQUENCIES), dtype=int)
    for seed in range(count):
        _, trace = diagnose_with_trace(baseline, recorded(200 + seed, 30.0))
        off = trace.ifrf.H[-1] - truth
        d = np.stack([off.real, off.imag], axis=-1)
        distance = [x @ np.linalg.solve(C, x) for x, C in zip(d, trace.ifrf.covariance[-1], strict=True)]
        inside += np.array(distance) < stats.chi2.ppf(0.95, 2)
    low, high = stats.binom.ppf([5e-4, 1.0 - 5e-4], count, 0.95)
    assert np.all((low <= inside) & (inside <= high)), inside
