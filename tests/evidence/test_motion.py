"""Motion that the baseline never saw: the verdict stays open, in plain words; true faults keep their names."""

from __future__ import annotations

import functools
import itertools
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from accuracy import motion as study
from accuracy import onset, rig
from accuracy.axis import AXES, RATE, loop, moves, random_motion, record

import servoscope as ss
from servoscope.baseline.motion import WINDOWS, RecordedMotion, motion_excess
from servoscope.core.errors import BaselineError, RecordingError
from servoscope.evidence.examination import Examination
from servoscope.service.assets.examination import examine_blocks
from servoscope.service.sources.block import Block
from servoscope.signals import Recording
from servoscope.simulation import reference


@functools.cache
def belt() -> ss.Baseline:
    """Return the baseline of the axis that misleads most: its load hangs on a belt."""
    return study.baseline("belt", 0)


def under(motion: str, seed: int = 7, name: str = "belt") -> Recording:
    return record(AXES[name], study.MOTIONS[motion](seed), seed)


def test_windows_are_means_over_the_samples_that_updated_the_estimate() -> None:
    """Against slices of the regressors themselves; a pulse of motion tells where a window begins and ends."""
    baseline, recording = belt(), under("as learned")
    pipeline = baseline.pipeline()
    motion = RecordedMotion.from_recording(pipeline, recording, 0.0)
    g = pipeline.regression(recording.r, recording.u, recording.y, recording.restart)
    at, used = 300, np.flatnonzero(g.ok)
    last = [k for k in used if k < (at + 1) * pipeline.every]
    length = round(WINDOWS[0][0] * pipeline.memory)
    phi = g.phi[last[-length:]]
    means, count = motion._means(slice(at, at + 1), *WINDOWS[0])
    assert abs(count[0] - length) <= pipeline.every  # whole evaluations
    np.testing.assert_allclose(means[0, 6:].reshape(4, 4), phi.T @ phi / len(phi), rtol=0.02, atol=1e-3)


def test_speed_and_frequency_of_a_sine() -> None:
    """Root mean squares of a sin(w t) are a/sqrt(2), a w/sqrt(2) and a w^2/sqrt(2); their frequency is w/2 pi."""
    t = np.arange(round(40.0 * RATE)) / RATE
    recording = record(AXES["ideal"], 0.1 * np.sin(2.0 * np.pi * 0.5 * t), 1)
    motion = RecordedMotion.from_recording(belt().pipeline(), recording, 0.0)
    values, filled = motion.quantities(slice(250, 251))
    w = 2.0 * np.pi * 0.5
    expected = 0.1 / np.sqrt(2.0) * np.array([1.0, w, w**2]), 0.5
    for of_r in values[0, :, 0]:
        np.testing.assert_allclose(of_r[:3], expected[0], rtol=0.03)
        assert of_r[3] == pytest.approx(expected[1], rel=0.02)
    assert (filled > 0.9).all()


@pytest.mark.parametrize("words", [words for words in study.MOTIONS if words != "as learned"])
def test_a_healthy_axis_under_a_motion_never_seen_is_no_fault(words: str) -> None:
    """The belt alarms under both random motions where the model is taken for exact, up to twice over the limit."""
    baseline, recording = belt(), under(words)
    exam = Examination.from_recording(baseline, recording)
    assert not exam.alarm.any()
    diagnosis = ss.diagnose(baseline, recording)
    assert diagnosis.verdict != "fault" and not diagnosis.faults
    if exam.apparent_alarm.any():
        assert diagnosis.verdict == "undetermined"
        assert "motion never seen: mean speed 0." in diagnosis.summary
        assert "in the healthy recordings)" in diagnosis.summary and "learn it too" in diagnosis.summary
    else:
        assert "random" not in words or "limits" not in words, "the limits are where the belt shows most"


def test_the_words_name_the_limits_of_u() -> None:
    assert "u is at a limit in" in ss.diagnose(belt(), under("random, u at its limits")).summary


@pytest.mark.parametrize("words", study.FAULTS)
@pytest.mark.parametrize("name", ["ideal", "belt"])
def test_true_faults_under_the_motion_that_was_learned_keep_their_names(words: str, name: str) -> None:
    """Nothing is added to the covariance there: a fault changes y a little, and r not at all."""
    parameter, spoil = study.FAULTS[words]
    recording = record(AXES[name], moves(11), 11, spoil(AXES[name]))
    diagnosis = ss.diagnose(study.baseline(name, 0), recording)
    assert [fault.parameter for fault in diagnosis.faults] == [parameter]
    assert not any(warning.kind == "motion" for warning in diagnosis.warnings)


def test_a_fault_beyond_what_the_model_may_be_off_is_still_found() -> None:
    """Twice the inertia under a random motion: found, with a wider interval, and the doubt is told."""
    twice = study.replace(AXES["belt"], mass=2.0 * AXES["belt"].mass)
    fault = {
        words: ss.diagnose(belt(), record(AXES["belt"], r, 11, twice))
        for words, r in (("moves", moves(11)), ("random", random_motion(11)))
    }
    sizes = {words: diagnosis.candidates[0].faults[0] for words, diagnosis in fault.items()}
    assert {size.parameter for size in sizes.values()} == {"inertia"}
    widths = {words: size.interval[1] - size.interval[0] for words, size in sizes.items()}
    assert widths["random"] > 2.0 * widths["moves"]
    assert [warning.kind for warning in fault["random"].warnings].count("motion") == 1
    assert all(warning.kind != "motion" for warning in fault["moves"].warnings)


@pytest.mark.parametrize("amplitude", [0.4, 0.7, 1.3, 1.6])
def test_a_square_root_valve_with_a_linear_file_is_no_leak_at_another_amplitude(amplitude: float) -> None:
    """From 1.2 times the amplitude on the statistic passes its limit, and leakage was named."""
    recording, _ = study.nonlinear.simulated("multisine", 50, amplitude, rig=study.VALVE)
    diagnosis = ss.diagnose(study.valve_baseline("multisine"), recording)
    assert diagnosis.verdict == "undetermined" and "motion never seen" in diagnosis.summary
    assert f"mean distance from the middle {0.0134 * amplitude:.2g}"[:-1] in diagnosis.summary


def test_a_plant_that_explains_its_recordings_holds_under_any_motion() -> None:
    """The reference rig's file is right, so a fault under a motion never seen is named as before."""
    learned = rig.baseline("multisine", 60.0, 0)
    assert learned.extrapolates and learned.motion is not None and learned.limited_motion is None
    r = 0.5 * reference("profile", 60.0, 100.0)
    leak = ss.simulate(rig.loop(), r, faults=[rig.FaultEvent("C_ie", 1.2, 30.0)], seed=3)[0]
    assert [fault.name for fault in ss.diagnose(learned, leak).faults] == ["leakage"]


def test_a_live_window_under_a_motion_never_seen_raises_no_alarm() -> None:
    recording = under("random, u at its limits")
    block = Block("axis", 0, recording.t, recording.r, recording.u, recording.y)
    examined = examine_blocks(belt(), "axis", [block])
    assert examined.verdict == "undetermined" and "motion never seen" in examined.summary


def test_a_wrong_unit_is_told_before_an_unseen_motion() -> None:
    """In mm both r and y move a thousand times as fast as ever."""
    recording = under("as learned")
    diagnosis = ss.diagnose(belt(), study.replace(recording, r=1e3 * recording.r, y=1e3 * recording.y))
    assert "r and y are in another unit: times 0.001" in diagnosis.summary


def test_a_baseline_of_an_earlier_version_says_that_the_check_is_missing(tmp_path: Path) -> None:
    path = tmp_path / "old.json"
    belt().save(path)
    content = json.loads(path.read_text())
    assert len(content.pop("motion")["least"]) == len(WINDOWS)
    path.write_text(json.dumps(content))
    old = ss.Baseline.load(path)
    diagnosis = ss.diagnose(old, under("random, u at its limits"))
    assert diagnosis.verdict == "fault"
    assert any("does not say which motion" in warning.message for warning in diagnosis.warnings)
    old.save(path)
    assert json.loads(path.read_text())["motion"] is None


def test_healthy_names_what_is_not_watched() -> None:
    said = ss.diagnose(belt(), under("as learned")).summary
    assert said.endswith(
        "Not monitored: a change of offset, backlash between actuator and sensor or a compliant drive train."
    )
    stiff = loop().plant.model_copy(update={"friction": "none", "offset": False, "order": 4})
    assert stiff.unwatched == ("backlash", "coulomb_friction", "load")


def test_signals_beyond_all_units_are_an_error_of_one_line() -> None:
    recording = under("as learned")
    with pytest.raises(RecordingError, match="check the units of r, u and y") as raised:
        ss.diagnose(belt(), study.replace(recording, y=1e300 * recording.y))
    assert "\n" not in str(raised.value)


def test_an_output_that_never_changes_says_nothing() -> None:
    """Of a loop that is known to the last sample it is less than the noise, by which the refit divided."""
    recording, _ = ss.simulate(rig.loop(), reference("multisine", 30.0, 100.0), seed=1)
    diagnosis = ss.diagnose(
        rig.baseline("multisine", 60.0, 0), study.replace(recording, u=0.0 * recording.u, y=0.0 * recording.y)
    )
    assert diagnosis.verdict == "undetermined" and not diagnosis.candidates


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cogging", "stribeck"])
def test_the_onset_is_dated_where_the_residual_is_no_noise(name: str) -> None:
    """Friction and magnets that the model lacks moved it by up to 40 s; of eight steps one may be outside by chance."""
    found = [onset.axis_job(0, name, runs=10)]
    seen = [run for run in found[0]["runs"] if "onset" in run and run["what"] != "shift"]
    inside = sum(run["onset"][0] <= run["begin"] <= run["onset"][2] for run in seen)
    assert len(seen) >= 5 and inside >= len(seen) - 1
    assert np.median([abs(run["onset"][1] - run["begin"]) for run in seen]) < 0.3
    assert all(len(row) == len(onset.TABLES[1].columns) for row in onset.covered_on_axis(name, found))


@functools.cache
def terms() -> ss.Baseline:
    """Return the baseline of an axis with Stribeck friction as a list of terms, which has a refit."""
    settings = loop().to_dict() | {"plant": {"kind": "axis", "terms": ["viscous", "coulomb", "offset"]}}
    recordings = [record(AXES["stribeck"], moves(seed, seconds=30.0), seed) for seed in range(4)]
    return ss.learn(ss.Loop.from_dict(settings), recordings)


@pytest.mark.parametrize(("time", "coulomb", "verdict"), [(2.0, 2.0, "fault"), (4.0, 2.0, "fault"), (4.0, 1.0, "")])
def test_an_axis_is_faulty_beyond_the_error_of_its_extrapolation(time: float, coulomb: float, verdict: str) -> None:
    """At half and a quarter of the learned speed: twice the friction is a fault, Stribeck friction is none."""
    axis = replace(AXES["stribeck"], coulomb=coulomb * AXES["stribeck"].coulomb)
    seeds = (11,) if verdict else (11, 12)
    for seed in seeds:
        recording = record(axis, moves(seed, time=time, seconds=30.0), seed)
        assert Examination.from_recording(terms(), recording).motion_excess(slice(None)).max() > 0.5
        diagnosis = ss.diagnose(terms(), recording)
        if verdict:
            assert diagnosis.verdict == "fault"
            assert any(warning.kind == "motion" for warning in diagnosis.warnings)
        else:
            assert diagnosis.verdict != "fault"


class TestMonitorWithMotionCheck:
    """`Monitor(motion_check=True)` beside the examination of the same recording, and beside itself."""

    @pytest.mark.parametrize("words", ["as learned", "random, u at its limits"])
    def test_it_alarms_as_the_examination_does(self, words: str) -> None:
        """Up to what the examination knows besides: a window around each sample that also looks ahead."""
        recording = under(words)
        exam, watched = Examination.from_recording(belt(), recording), ss.Monitor(belt(), motion_check=True)
        _, trace = watched.run(watched.init(), recording.r, recording.u, recording.y, recording.restart)
        plain = ss.Monitor(belt())
        _, without = plain.run(plain.init(), recording.r, recording.u, recording.y, recording.restart)
        assert trace.motion is not None and without.motion is None
        assert (trace.statistic <= without.statistic).all()
        if words == "as learned":
            assert np.array_equal(trace.statistic[trace.motion < 0.05], without.statistic[trace.motion < 0.05])
            assert not trace.exceeded.any()
        else:
            assert without.exceeded.any(), "the check has something to do"
            assert trace.exceeded.sum() < 0.1 * without.exceeded.sum()
            assert "motion" in trace.table() and "motion" not in without.table()
        assert not exam.alarm.any()

    def test_its_windows_are_those_of_a_whole_recording(self) -> None:
        recording, baseline = under("larger"), belt()
        seen = baseline.limited_motion
        assert seen is not None
        whole = RecordedMotion.from_recording(baseline.pipeline(), recording, seen.origin)
        values, filled = whole.quantities(slice(None))
        expected = np.abs(motion_excess(baseline.pipeline(), seen, values[:, :1], filled[:, :1])).max(axis=1)
        watched = ss.Monitor(baseline, motion_check=True)
        _, trace = watched.run(watched.init(), recording.r, recording.u, recording.y, recording.restart)
        off = np.abs(trace.motion - expected)
        assert np.mean(off < 1e-9) > 0.9
        assert off.max() < 0.005, "around a rest a window begins up to an evaluation's samples elsewhere"

    @pytest.mark.parametrize("cuts", [[7, 2501, 2502], [9_999]])
    def test_it_is_split_and_resumed_anywhere(self, cuts: list[int]) -> None:
        """Gaps and missing values included; `step` is a block of one sample."""
        recording = under("random, 2 Hz")[:12_000]
        columns, restart = [recording.r, recording.u, recording.y.copy()], recording.restart.copy()
        columns[2][3_000:3_040], restart[6_000] = np.nan, True
        watched = ss.Monitor(belt(), motion_check=True)
        state, whole = watched.run(watched.init(), *columns, restart)
        part, found = watched.init(), []
        for begin, end in itertools.pairwise([0, *cuts, 12_000]):
            part, trace = watched.run(part, *(x[begin:end] for x in columns), restart[begin:end])
            found.append(trace)
            watched = ss.Monitor(belt(), motion_check=True)
        assert np.array_equal(part, state)
        for name in ("motion", "statistic", "level"):
            assert np.array_equal(np.concatenate([getattr(one, name) for one in found]), getattr(whole, name))

    def test_sample_by_sample_equals_a_block(self) -> None:
        recording = under("random, 2 Hz")[:1_500]
        watched = ss.Monitor(belt(), motion_check=True)
        end, whole = watched.run(watched.init(), recording.r, recording.u, recording.y)
        state, found = watched.init(), list[float]()
        for sample in zip(recording.r, recording.u, recording.y, strict=True):
            if watched.step(state, *sample):
                latest = watched.latest(state)
                assert latest.motion is not None
                found.append(float(latest.motion[0]))
        assert np.array_equal(state, end)
        assert np.array_equal(found, whole.motion)

    def test_the_assets_of_a_fleet_are_checked_one_by_one(self) -> None:
        """Each has what its own monitor says; T^2 to the bits, under the same motion and another one."""
        recordings = [under(words)[:6_000] for words in ("as learned", "random, u at its limits")]
        fleet = ss.Monitor([belt(), belt()], motion_check=True)
        signals = [np.stack([getattr(one, name) for one in recordings]) for name in ("r", "u", "y", "restart")]
        state, first = fleet.run(fleet.init(), *(x[:, :2_501] for x in signals))
        state, rest = fleet.run(state, *(x[:, 2_501:] for x in signals))
        latest = fleet.latest(state)
        for asset, one in enumerate(recordings):
            watched = ss.Monitor(belt(), motion_check=True)
            end, trace = watched.run(watched.init(), one.r, one.u, one.y, one.restart)
            for name in ("motion", "statistic"):
                together = np.concatenate([getattr(part.lane(asset), name) for part in (first, rest)])
                assert np.array_equal(together, getattr(trace, name))
                assert np.array_equal(getattr(latest.lane(asset), name), getattr(watched.latest(end), name))

    def test_refusals(self) -> None:
        with pytest.raises(BaselineError, match="learn it again"):
            ss.Monitor(belt().model_copy(update={"motion": None}), motion_check=True)
