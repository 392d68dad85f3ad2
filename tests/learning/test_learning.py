"""What a baseline is made of: noise, delay, healthy parameters, promises, notes; saved, read back, or refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servoscope.baseline.baseline import Baseline
from servoscope.core.errors import BaselineError, NotEnoughError, RecordingError
from servoscope.diagnosis import operating_points
from servoscope.diagnosis.diagnose import diagnose
from servoscope.learning.learn import learn_baseline, nominal_baseline
from servoscope.models.loop import Loop
from servoscope.signals import Recording
from servoscope.signals.recording import thin_out
from servoscope.simulation import FaultEvent, reference, simulate


@pytest.fixture(scope="module")
def record() -> Callable[..., Recording]:
    def simulated(loop: Loop, kind: str = "profile", seconds: float = 60.0, seed: int = 1, **options: Any) -> Recording:
        return simulate(loop, reference(kind, seconds, loop.sample_rate), seed=seed, **options)[0]

    return simulated


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory, record: Callable[..., Recording]) -> Path:
    loop = Loop.load(Path(__file__).parents[2] / "src/servoscope/simulation/reference-rig.toml")
    path = tmp_path_factory.mktemp("baseline") / "b.json"
    learn_baseline(loop, [record(loop)]).save(path)
    return path


def test_finds_noise_and_healthy_parameters(rig: dict[str, Any], record: Callable[..., Recording]) -> None:
    loop = Loop.from_dict(rig)
    aged = loop.model_copy(update={"plant": loop.plant.with_ratios({"p_s": 0.8, "C_ie": 1.5})})
    baseline = learn_baseline(loop, [record(aged)])  # the loop file is wrong: the recording knows better
    assert baseline.healthy.noise is not None
    assert baseline.healthy.noise.y_std == pytest.approx(np.sqrt(1e-7), rel=0.1)
    # whether it aged in two parameters or the file is wrong in all, the coefficients do not say; they are known
    assert baseline.theta[:2] == pytest.approx(aged.plant.theta()[:2], rel=0.002)
    assert any("contradict the parameters in [plant]" in str(note) for note in baseline.notes)
    worse = record(aged, seed=2, faults=[FaultEvent("C_ie", 1.2, 30.0)])
    (fault,) = diagnose(baseline, worse).faults
    assert fault.ratio == pytest.approx(1.2, rel=0.01)


def test_scatter_between_recordings_counts(rig: dict[str, Any], record: Callable[..., Recording]) -> None:
    loop = Loop.from_dict(rig)
    colder = loop.model_copy(update={"plant": loop.plant.with_ratios({"C_ie": 1.03})})
    same = learn_baseline(loop, [record(loop, seed=1), record(loop, seed=2)])
    mixed = learn_baseline(loop, [record(loop, seed=1), record(colder, seed=2)])
    assert mixed.covariance[0][0] > 10.0 * same.covariance[0][0]
    by_parameter = {p.parameter: p.change for p in mixed.detectability.changes}
    assert by_parameter["C_ie"] is not None and by_parameter["C_ie"] > 0.05


def test_of_long_recordings_stretches_are_learned_and_the_whole_is_judged(
    rig: dict[str, Any], record: Callable[..., Recording], monkeypatch: pytest.MonkeyPatch
) -> None:
    loop = Loop.from_dict(rig)
    day = record(loop, seconds=600.0)
    monkeypatch.setattr(operating_points, "MAX_SAMPLES", 20_000)
    learned = operating_points.learn(loop, day)
    assert learned.sources[0].samples == day.samples == 60_000  # of the file, by which it is found again
    (note,) = [str(note) for note in learned.notes if "evenly spread" in str(note)]
    assert "learned from 20000 of 60000 rows" in note and "Healthy" in note
    worn = record(loop, seconds=600.0, faults=[FaultEvent("C_ie", 1.3, 300.0)])
    assert diagnose(learned, worn).faults[0].ratio == pytest.approx(1.3, rel=0.05)
    stretches = thin_out(day, 20_000, 5000)
    assert stretches.restart.sum() == 4 and stretches.t[0] == day.t[0] and stretches.t[-1] == day.t[-1]
    assert np.array_equal(stretches.y[:5000], day.y[:5000]) and not day.restart[1:].any()


def test_more_data_promise_more(rig: dict[str, Any], record: Callable[..., Recording]) -> None:
    loop = Loop.from_dict(rig)
    short, long = (learn_baseline(loop, [record(loop, seconds=seconds)]) for seconds in (30.0, 120.0))
    assert any("short" in str(note) for note in short.notes)
    assert np.all(np.diag(short.covariance_array()) > np.diag(long.covariance_array()))
    few, many = ({p.parameter: p.change for p in baseline.detectability.changes} for baseline in (short, long))
    for parameter in ("b_p", "beta"):
        assert few[parameter] > many[parameter]
    for parameter in ("p_s", "C_ie"):  # the recursion's own scatter limits them; half a minute hardly tells its noise
        assert few[parameter] > 0.9 * many[parameter]
    assert short.thresholds.statistic > long.thresholds.statistic  # the noise itself is known less well


def test_refuses_recordings_out_of_step(rig: dict[str, Any], record: Callable[..., Recording]) -> None:
    loop = Loop.from_dict(rig)
    late = record(Loop.from_dict(rig | {"delay": 0.01}))
    with pytest.raises(RecordingError, match=r"delay = 0\.01"):
        learn_baseline(loop, [late])
    told = learn_baseline(Loop.from_dict(rig | {"delay": 0.01}), [late])
    assert told.delay_s == pytest.approx(0.01, abs=0.001)


def test_refuses_what_excites_nothing(rig: dict[str, Any], record: Callable[..., Recording]) -> None:
    loop = Loop.from_dict(rig)
    with pytest.raises(NotEnoughError, match="usable samples"):
        learn_baseline(loop, [record(loop).part(0.0, 0.9)])
    with pytest.raises(NotEnoughError, match="at least one"):
        learn_baseline(loop, [])


def test_suggests_a_model_error_where_the_model_is_wrong(rig: dict[str, Any], record: Callable[..., Recording]) -> None:
    loop = Loop.from_dict(rig)
    bent = record(loop)
    bent = replace(bent, u=bent.u * (1.0 + 2.0 * np.abs(bent.u)))  # a valve that saturates
    baseline = learn_baseline(loop, [bent])
    assert baseline.detectability.suggested_model_error > 0.001
    assert learn_baseline(loop, [record(loop)]).detectability.suggested_model_error < 0.001


def test_a_useless_instrument_is_replaced_and_told(rig: dict[str, Any], record: Callable[..., Recording]) -> None:
    loop = Loop.from_dict(rig | {"monitor": {"estimator": "iv-akf"}})
    good = record(loop, kind="multisine")
    assert learn_baseline(loop, [good]).loop.monitor.estimator == "iv-akf"
    shuffled = replace(good, r=np.roll(good.r, 333))  # an r that u and y know nothing of
    baseline = learn_baseline(loop, [shuffled])
    assert baseline.loop.monitor.estimator == "akf"
    assert any("instrument is too weak" in str(note) for note in baseline.notes)


def test_an_instrument_that_fails_later_is_replaced_and_told(
    rig: dict[str, Any], record: Callable[..., Recording]
) -> None:
    loop = Loop.from_dict(rig | {"monitor": {"estimator": "iv-akf"}})
    baseline = learn_baseline(loop, [record(loop, kind="multisine")])
    other = record(loop, kind="multisine", seed=2)
    diagnosis = diagnose(baseline, replace(other, r=-other.r))
    assert any(warning.kind == "instrument" and "akf" in warning.message for warning in diagnosis.warnings)


def test_a_noisier_sensor_is_told_and_not_taken_for_a_fault(
    rig: dict[str, Any], record: Callable[..., Recording]
) -> None:
    """The noise in the regressors moves theta; without its growth in the expectation it looks like contamination."""
    loop = Loop.from_dict(rig)
    baseline = learn_baseline(loop, [record(loop)])
    for seed in (2, 3):
        diagnosis = diagnose(baseline, record(loop, seed=seed, noise_y_std=3.0 * np.sqrt(1e-7)))
        assert diagnosis.verdict == "healthy"
        (told,) = [warning for warning in diagnosis.warnings if warning.kind == "noise"]
        # of the power over a memory a low quantile counts, so the factor comes out a few per cent low, and scatters
        assert told.description.values["factor"] == pytest.approx(2.9, rel=0.06)


def test_an_input_at_its_limits_says_nothing(rig: dict[str, Any], record: Callable[..., Recording]) -> None:
    loop = Loop.from_dict(rig)
    baseline = learn_baseline(loop, [record(loop)])
    stuck = Loop.from_dict(rig | {"input_limits": [-1e-3, 1e-3]})
    pinned = record(loop)
    pinned = replace(pinned, u=np.clip(pinned.u, -1e-3, 1e-3))
    with pytest.raises(NotEnoughError, match="at a limit"):
        learn_baseline(stuck, [pinned])
    limited = baseline.model_copy(update={"loop_settings": stuck.to_dict()})
    assert diagnose(limited, pinned).verdict != "healthy"


def test_polynomial_with_nominal_values_needs_no_learning(record: Callable[..., Recording]) -> None:
    axis = Loop.from_dict(
        {
            "sample_rate": 100.0,
            "plant": {
                "kind": "polynomial",
                "order": 2,
                "coefficients": {"viscous_friction": 50.0, "inertia": 2.0},
            },
            "controller": {"kind": "pi", "k_p": 300.0, "k_i": 0.0},
        }
    )
    baseline = nominal_baseline(axis)
    assert baseline.theta == pytest.approx((50.0, 2.0), rel=0.2)  # with the bias of this noise in it


def test_nominal_baseline_finds_faults_without_learning(rig: dict[str, Any], record: Callable[..., Recording]) -> None:
    loop = Loop.from_dict(rig)
    baseline = nominal_baseline(loop)
    assert diagnose(baseline, record(loop, kind="multisine", seed=3)).verdict == "healthy"
    (fault,) = diagnose(baseline, record(loop, seed=4, faults=[FaultEvent("p_s", 1.4, 20.0)])).faults
    assert fault.name == "pump"
    assert fault.ratio == pytest.approx(1.4, rel=0.01)


class TestFile:
    def test_round_trip_changes_nothing(self, saved: Path, tmp_path: Path) -> None:
        baseline = Baseline.load(saved)
        baseline.save(tmp_path / "again.json")
        assert (tmp_path / "again.json").read_bytes() == saved.read_bytes()
        assert baseline.loop == Baseline.load(tmp_path / "again.json").loop

    @pytest.mark.parametrize(
        ("change", "told"),
        [
            ({"version": 99}, "version 99"),
            ({"format": "other"}, "not a baseline"),
            ({"theta": None}, "theta"),
            ({"loop": {"name": "x"}}, "damaged"),
            ({"unheard": 1}, "unheard"),
            ({"theta": [1.0]}, "theta must have 4"),
            ({"recursion": {"scale": [1.0]}}, "recursion"),
            ({"thresholds": {"dof": 9.0, "statistic": -1.0, "calibration": {}}}, "positive"),
            ({"covariance": [[1.0, 0.0], [0.0, 1.0]]}, "4 by 4"),
            ({"covariance": (-np.eye(4)).tolist()}, "positive"),
        ],
    )
    def test_damage_is_refused(self, saved: Path, tmp_path: Path, change: dict[str, Any], told: str) -> None:
        path = tmp_path / "b.json"
        path.write_text(json.dumps(json.loads(saved.read_text()) | change))
        with pytest.raises(BaselineError, match=told) as caught:
            Baseline.load(path)
        assert str(path) in str(caught.value) and "\n" not in str(caught.value)

    def test_torn_file_is_refused(self, saved: Path, tmp_path: Path) -> None:
        path = tmp_path / "b.json"
        path.write_text(saved.read_text()[:500])
        with pytest.raises(BaselineError, match="no JSON"):
            Baseline.load(path)


@pytest.mark.parametrize("seconds", [0.02, 0.1, 0.2])
def test_a_blink_of_a_recording_is_undetermined(
    rig: dict[str, Any], record: Callable[..., Recording], seconds: float
) -> None:
    loop = Loop.from_dict(rig)
    assert (
        diagnose(learn_baseline(loop, [record(loop)]), record(loop, seconds=seconds, seed=2)).verdict == "undetermined"
    )


def test_a_slowly_ringing_loop_keeps_its_noise_apart(rig: dict[str, Any], record: Callable[..., Recording]) -> None:
    """The closed loop's poles, not the filters', say how long the noise is remembered."""
    loop = Loop.from_dict(rig | {"delay": 0.013})
    baseline = learn_baseline(loop, [record(loop)])
    assert baseline.healthy.noise is not None and baseline.thresholds.hypotheses
    assert baseline.healthy.noise.u_std == pytest.approx(1e-4, rel=0.6)
    assert baseline.healthy.noise.y_std == pytest.approx(np.sqrt(1e-7), rel=0.05)
    assert diagnose(baseline, record(loop, seed=3)).verdict == "healthy"


def test_a_loop_that_is_held_at_rest_can_be_simulated_too(
    rig: dict[str, Any], record: Callable[..., Recording]
) -> None:
    loop = Loop.from_dict(rig | {"monitor": {"update_when": "moving", "rest_speed": 0.005}})
    baseline = learn_baseline(loop, [record(loop, kind="profile")])
    assert diagnose(baseline, record(loop, kind="profile", seed=4)).verdict == "healthy"


def test_silence_is_no_obstacle(rig: dict[str, Any], record: Callable[..., Recording]) -> None:
    loop = Loop.from_dict(rig)
    quiet = {"noise_u_std": 0.0, "noise_y_std": 0.0}
    assert diagnose(learn_baseline(loop, [record(loop, **quiet)]), record(loop, seed=5, **quiet)).verdict == "healthy"


def test_one_recording_too_short_among_others_is_refused(rig: dict[str, Any], record: Callable[..., Recording]) -> None:
    loop = Loop.from_dict(rig)
    short = replace(record(loop, seconds=0.3, seed=2), name="short.csv")
    with pytest.raises(NotEnoughError, match=r"^short\.csv: only \d+ usable samples of at least 80 "):
        learn_baseline(loop, [record(loop), short])


def test_a_rehearsal_is_as_long_as_the_memory_asks(rig: dict[str, Any], record: Callable[..., Recording]) -> None:
    """On a short one alarms run into each other, and the few that are counted would lower the limit."""
    shares = []
    for memory in (5.0, 20.0):
        loop = Loop.from_dict(rig | {"monitor": {"memory": memory}})
        shares.append(learn_baseline(loop, [record(loop, seconds=240.0)]).thresholds.calibration.statistic)
    assert shares[1] == pytest.approx(shares[0], rel=0.5)


def test_nothing_to_learn_from_is_said() -> None:
    with pytest.raises(NotEnoughError, match="give at least one healthy recording"):
        operating_points.learn(Loop.from_dict({"name": "axis", "sample_rate": 100.0, "plant": {"kind": "axis"}}), [])
