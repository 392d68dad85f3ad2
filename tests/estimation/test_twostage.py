"""Stage 1: u_a is r through what was learned of r -> u, free of u's noise, whatever the blocks it comes in."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from servoscope.baseline.baseline import Baseline
from servoscope.core.errors import LoopError, NotEnoughError
from servoscope.diagnosis.diagnose import diagnose
from servoscope.diagnosis.monitor import Monitor
from servoscope.estimation import estimators
from servoscope.estimation.pipeline import Pipeline
from servoscope.estimation.two_stage import StageOneRunner, basis_functions, basis_settling_samples, tune_stage_one
from servoscope.learning.learn import learn_baseline
from servoscope.models.loop import Loop
from servoscope.research.paper.conditions import rig_loop as reference_rig
from servoscope.signals import Recording
from servoscope.simulation import FaultEvent, reference, simulate

SILENT = {"noise_u_std": 0.0, "noise_y_std": 0.0}


def loop_of(rig: dict[str, Any], **monitor: Any) -> Loop:
    return Loop.from_dict(rig | {"monitor": {"two_stage": "adaptive", **monitor}})


def recorded(loop: Loop, seed: int, seconds: float = 60.0, kind: str = "profile", **how: Any) -> Recording:
    return simulate(loop, reference(kind, seconds, loop.sample_rate), seed=seed, **how)[0]


def u_a(loop: Loop, healthy: Recording, recording: Recording) -> np.ndarray[Any, np.dtype[np.float64]]:
    stage = StageOneRunner(loop, tune_stage_one(loop, [healthy]))
    return stage.run(stage.start(), recording.r, recording.u, recording.restart)


def test_laguerre_functions_are_orthonormal_and_what_their_definition_says(rig: dict[str, Any]) -> None:
    system = basis_functions(loop_of(rig, stage_one="laguerre", stage_one_length=5, stage_one_pole=0.7))
    impulse = np.zeros((400, 1))
    impulse[1] = 1.0
    l = system.simulate(impulse)[1:]
    assert l.T @ l == pytest.approx(np.eye(5), abs=1e-9)
    from scipy.signal import lfilter

    a, delta = 0.7, impulse[1:, 0]
    expected = lfilter([np.sqrt(1.0 - a * a)], [1.0, -a], delta)
    for i in range(5):
        assert l[:, i] == pytest.approx(expected, abs=1e-12)
        expected = lfilter([-a, 1.0], [1.0, -a], expected)


def test_fir_functions_are_the_last_samples_of_r_and_forget_after_them(rig: dict[str, Any]) -> None:
    system = basis_functions(loop_of(rig, stage_one_length=4))
    r = np.arange(10.0)[:, None]
    assert system.simulate(r)[5].tolist() == [5.0, 4.0, 3.0, 2.0]
    assert basis_settling_samples(system) == 3


@pytest.mark.parametrize("settings", [{}, {"stage_one": "laguerre"}], ids=["fir", "laguerre"])
@pytest.mark.parametrize("fault", [(), (FaultEvent("p_s", 1.4, 30.0),)], ids=["healthy", "pump"])
def test_u_a_follows_the_noise_free_input(rig: dict[str, Any], settings: Any, fault: Any) -> None:
    loop = loop_of(rig, **settings)
    noisy, clean = recorded(loop, 2, faults=fault), recorded(loop, 2, faults=fault, **SILENT)
    late = slice(5000, None)
    error = (u_a(loop, recorded(loop, 1), noisy) - clean.u)[late].std()
    assert error < 0.4 * (noisy.u - clean.u)[late].std()


def test_the_noise_of_a_sample_has_no_share_in_its_own_u_a(rig: dict[str, Any]) -> None:
    loop, healthy = loop_of(rig, stage_one_length=10), recorded(loop_of(rig), 1, 20.0)
    changed = replace(healthy, u=np.where(np.arange(2000) == 1000, 99.0, healthy.u))
    first, second = u_a(loop, healthy, healthy), u_a(loop, healthy, changed)
    same = first == second
    assert same[20:1001].all() and not same[1001]


@pytest.mark.parametrize("name", estimators.estimator_names())
def test_every_estimator_runs_stage_one_and_blocks_change_nothing(rig: dict[str, Any], name: str) -> None:
    loop = loop_of(rig, estimator=name, stage_one="laguerre", stage_one_length=6)
    healthy = recorded(loop, 1, 30.0)
    stage = StageOneRunner(loop, tune_stage_one(loop, [healthy]))
    r, u, restart = healthy.r.copy(), healthy.u.copy(), healthy.restart.copy()
    u[700], restart[1500] = np.nan, True
    whole_state, split_state = stage.start(), stage.start()
    whole = stage.run(whole_state, r, u, restart)
    parts = [
        stage.run(split_state, r[k], u[k], restart[k]) for k in (slice(0, 701), slice(701, 1500), slice(1500, None))
    ]
    assert np.array_equal(whole, np.concatenate(parts), equal_nan=True)
    assert np.array_equal(whole_state, split_state)
    assert np.isfinite(whole[2000:]).all()


def test_a_gap_silences_u_a_until_the_functions_have_forgotten_it(rig: dict[str, Any]) -> None:
    loop, healthy = loop_of(rig, stage_one_length=10), recorded(loop_of(rig), 1, 20.0)
    u = healthy.u.copy()
    u[500] = np.nan
    gone = np.flatnonzero(~np.isfinite(u_a(loop, healthy, replace(healthy, u=u))))
    assert gone.tolist() == [*range(9), *range(500, 510)]


@pytest.fixture(scope="module")
def baseline() -> Baseline:
    loop = reference_rig(two_stage="adaptive", stage_one="laguerre")
    return learn_baseline(loop, [recorded(loop, 1)])


class TestMonitor:
    """A monitor with two stages, through the same doors as one without."""

    def test_sample_by_sample_block_by_block_and_whole_are_one(self, baseline: Baseline) -> None:
        recording = recorded(baseline.loop, 2, 20.0)
        signals = recording.r, recording.u, recording.y
        monitor = Monitor(baseline)
        state, trace = monitor.run(monitor.init(), *signals)
        first, one = monitor.run(monitor.init(), *(signal[:1237] for signal in signals))
        second, two = monitor.run(first, *(signal[1237:] for signal in signals))
        assert np.array_equal(second, state)
        assert np.array_equal(np.concatenate([one.theta, two.theta]), trace.theta)
        stepped = monitor.init()
        for k in range(recording.samples):
            monitor.step(stepped, *(float(signal[k]) for signal in signals))
        assert np.array_equal(stepped, state)
        assert np.array_equal(monitor.latest(stepped).theta[0], trace.theta[-1])
        raw = baseline.pipeline().estimate(baseline.tuning, recording).theta
        assert trace.theta == pytest.approx(raw - baseline.bias, rel=1e-12, abs=1e-12)

    @pytest.mark.slow
    def test_a_fleet_is_its_assets(self, baseline: Baseline) -> None:
        recordings = [recorded(baseline.loop, seed, 20.0) for seed in (2, 3)]
        fleet = Monitor([baseline, baseline])
        r, u, y = (np.array([getattr(rec, name) for rec in recordings]) for name in "ruy")
        together, _ = fleet.run(fleet.init(), r, u, y)
        single = Monitor(baseline)
        for state, rec in zip(together, recordings, strict=True):
            assert np.array_equal(single.run(single.init(), rec.r, rec.u, rec.y)[0], state)

    def test_a_saved_baseline_brings_stage_one_back(self, baseline: Baseline, tmp_path: Any) -> None:
        baseline.save(tmp_path / "baseline.json")
        assert Baseline.load(tmp_path / "baseline.json") == baseline

    def test_it_tells_healthy_from_faulty(self, baseline: Baseline) -> None:
        assert diagnose(baseline, recorded(baseline.loop, 2)).verdict == "healthy"
        fault = (FaultEvent("p_s", 1.2, 30.0),)
        said = diagnose(baseline, recorded(baseline.loop, 3, faults=fault))
        (found,) = said.faults
        assert found.name == "pump" and found.ratio == pytest.approx(1.2, rel=0.01)
        assert said.onset_s is not None
        assert said.onset_s[0] <= 30.0 <= said.onset_s[2] and said.onset_s[2] - said.onset_s[0] < 1.0


def test_what_cannot_be_is_refused(rig: dict[str, Any]) -> None:
    loop = loop_of(rig)
    with pytest.raises(LoopError, match="learn a baseline"):
        Pipeline.of(loop)
    with pytest.raises(NotEnoughError, match="stage_one_length"):
        tune_stage_one(loop, [recorded(loop, 1, 1.0)])
    still = replace(recorded(loop, 1, 10.0), r=np.zeros(1000))
    with pytest.raises(NotEnoughError, match="reference is zero"):
        tune_stage_one(loop, [still])
    assert tune_stage_one(Loop.from_dict(rig), [still]) is None
