"""Examinations of a service: what is spared on the way to them changes no bit, and they never come all at once."""

from __future__ import annotations

import functools
import pickle

import halls
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servoscope.baseline.baseline import Baseline
from servoscope.baseline.expectation import Expectation, reference_path
from servoscope.core.errors import RecordingError
from servoscope.core.messages import message
from servoscope.detection.baseline_run import baseline_run
from servoscope.detection.cusum_design import sure_level, worst_case_hypotheses
from servoscope.detection.statistic import whiten
from servoscope.diagnosis.diagnose import diagnose_examination
from servoscope.evidence.examination import Examination
from servoscope.learning.learn import learn_baseline
from servoscope.models.loop import Loop
from servoscope.service.assets.examination import StoredDiagnosis, blocks_to_recording, examine_blocks, undetermined
from servoscope.service.assets.examination_schedule import FIRST_PER_S, ExaminationState, is_at_rest, update_examination
from servoscope.service.config import DiagnosisSettings
from servoscope.service.sources.block import Block
from servoscope.signals import Recording, time_axis
from servoscope.simulation import FaultEvent, reference, simulate

START = 1767225600.0
YEAR = 365.25 * 86400.0


def blocks_of(recording: Recording) -> list[Block]:
    """A recording as a service keeps it, in blocks of a second."""
    rows = np.stack([START + recording.t, recording.r, recording.u, recording.y])
    return [Block.from_signals("a", k, part) for k, part in enumerate(np.split(rows, recording.samples // 100, axis=1))]


@functools.cache
def rig() -> Baseline:
    loop = Loop.load(halls.LOOP)
    return learn_baseline(loop, [simulate(loop, reference("multisine", 60.0, loop.sample_rate), seed=9)[0]])


def window(seed: int, kind: str = "multisine", *faults: FaultEvent) -> list[Block]:
    loop = Loop.load(halls.LOOP)
    return blocks_of(simulate(loop, reference(kind, 30.0, loop.sample_rate), seed=seed, faults=faults)[0])


def slowly(baseline: Baseline, blocks: list[Block]) -> StoredDiagnosis | None:
    """What a healthy window is stored as, the obvious way: everything computed anew; None where there is an alarm."""
    anew = Baseline.model_validate(baseline.model_dump(by_alias=True))
    exam = Examination.from_recording(anew, blocks_to_recording(anew, "a", blocks)[0])
    if exam.alarm.any():
        return None
    found = diagnose_examination(exam)[0]
    return StoredDiagnosis(verdict=found.verdict, headline=found.headline, document=found.model_dump(mode="json"))


def with_budget(per_year: float) -> Baseline:
    """The rig's baseline, whose sequential test may raise so many false alarms."""
    loop = rig().loop
    monitor = loop.monitor.model_copy(update={"false_alarms_per_year": per_year})
    settings = loop.model_copy(update={"monitor": monitor}).to_dict()
    thresholds = rig().thresholds.model_copy(update={"statistic": 1e6})
    return rig().model_copy(update={"loop_settings": settings, "thresholds": thresholds})


def test_what_is_stored_is_that_of_a_full_examination() -> None:
    baseline = rig()
    for blocks in (window(1), window(2, "trapezoid"), window(3, "profile")):
        stored = examine_blocks(baseline, "a", blocks)
        assert stored == slowly(baseline, blocks)
        assert stored.verdict == "healthy"
        assert examine_blocks(baseline, "a", blocks, known="undetermined") == stored
        again = examine_blocks(baseline, "a", blocks, known="healthy")
        assert again == stored.model_copy(update={"document": {}})
        assert examine_blocks(baseline, "a", blocks) == stored  # nothing of a window stays in what is kept
    leak = window(4, "multisine", FaultEvent.parse("C_ie=1.2@10"))
    assert slowly(baseline, leak) is None
    assert examine_blocks(baseline, "a", leak).verdict == "fault"


def test_limits_that_matter_are_those_of_the_reference() -> None:
    """With thousands of false alarms a day the level is between both limits again and again."""
    judged, close = set[str](), 0
    for per_year in (20.0 * YEAR / 30.0, 2.0 * YEAR / 30.0, 0.1 * YEAR / 30.0):
        baseline = with_budget(per_year)
        for seed in range(3):
            blocks = window(seed, ("multisine", "trapezoid", "profile")[seed])
            stored, slow = examine_blocks(baseline, "a", blocks), slowly(baseline, blocks)
            judged.add(stored.verdict)
            if slow is None:
                assert stored.verdict == "fault" or stored.headline == message("service.examination.recovering")
            else:
                assert stored == slow
            own = baseline_run(baseline).estimates.again().advance(blocks_to_recording(baseline, "a", blocks)[0])
            close += slow is not None and own.level.max() >= baseline_run(baseline).sure_level
    assert close and len(judged) > 1  # otherwise this has shown nothing


@pytest.mark.parametrize("per_year", [1.0, 1e3, 1e5])
def test_no_reference_makes_limits_lower_than_the_sure_level(per_year: float) -> None:
    baseline = rig()
    loop, members = baseline.loop, baseline.thresholds.hypotheses
    sure = sure_level(members, per_year)
    assert 0.2 < sure < 1.0
    kept = [member for member in members if np.isfinite(member.limit(per_year / len(members)))]
    own = {id(member): member.limit(per_year / len(kept)) for member in kept}
    for kind in ("multisine", "trapezoid", "profile"):
        record, _ = simulate(loop, reference(kind, 30.0, loop.sample_rate), seed=1)
        assert baseline.healthy.noise is not None and baseline.healthy.loudest is not None
        expectation = Expectation(baseline.pipeline(), baseline.tuning, baseline.healthy.noise, reference_path(record))
        covariance = np.array(baseline.healthy.covariance)
        fitted = worst_case_hypotheses(expectation, baseline.plant, baseline.healthy.loudest, covariance, members)
        heard = [one for one in zip(fitted, members, strict=True) if np.isfinite(one[0].limit(per_year / len(fitted)))]
        for after, before in heard:
            assert after.limit(per_year / len(heard)) >= sure * own[id(before)]


def test_a_copy_takes_along_what_holds_for_it_only() -> None:
    baseline = Baseline.model_validate(rig().model_dump(by_alias=True))
    pipeline, run = baseline.pipeline(), baseline_run(baseline)
    bare = baseline.model_copy(update={"features": None, "point": "cold"})
    assert bare.pipeline() is pipeline and baseline_run(bare) is run
    moved = baseline.model_copy(update={"theta": tuple(1.1 * x for x in baseline.theta)})
    assert moved.pipeline() is pipeline and baseline_run(moved) is not run
    settings = baseline.loop.to_dict()
    other = baseline.model_copy(update={"loop_settings": settings | {"delay": 0.01}})
    assert other.loop.delay == 0.01 and other.pipeline() is not pipeline
    assert pickle.loads(pickle.dumps(baseline)).pipeline().every == pipeline.every


@given(st.data())
def test_a_regular_time_axis_is_laid_as_any_other(data: st.DataObject) -> None:
    rate, count = data.draw(st.sampled_from([10.0, 100.0, 333.0])), data.draw(st.integers(30, 200))
    spread, drift = data.draw(st.sampled_from([0.0, 1e-9, 0.02, 0.045, 0.06, 0.3])), data.draw(st.floats(-0.004, 0.004))
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    t = (np.arange(count) * (1.0 + drift) + spread * rng.uniform(-1.0, 1.0, count)) / rate
    if (odd := data.draw(st.sampled_from([None, np.nan, np.inf, -np.inf, 1e101, 1e308, -1.0, 0.1]))) is not None:
        t[data.draw(st.integers(0, count - 1))] = odd
    expected = data.draw(st.sampled_from([None, rate, 1.1 * rate]))

    def lay() -> object:
        try:
            axis = time_axis.build_time_axis(t, None, expected, "log")
        except RecordingError as error:
            return str(error)
        arrays = [x.tobytes() for x in (axis.t, axis.run, axis.dropped)]
        return arrays, axis.sample_rate, axis.defects, [(first, rows.tolist()) for first, rows in axis.sorted_rows]

    quickly = lay()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(time_axis, "_as_it_stands", lambda t, sample_rate: None)
        assert lay() == quickly


def test_what_is_whitened_is_what_lapack_makes_of_it() -> None:
    rng = np.random.default_rng(3)
    roots, units = rng.normal(size=(50, 4, 4)), np.array([1.0, 1e-6, 1e3, 1.0])
    covariance = roots @ np.swapaxes(roots, 1, 2) * np.outer(units, units)
    deviation = rng.normal(size=(50, 4, 3)) * units[:, None]
    expected = np.linalg.solve(covariance, deviation)
    white = whiten(covariance, deviation)
    np.testing.assert_allclose(
        np.swapaxes(white, 1, 2) @ white, np.swapaxes(deviation, 1, 2) @ expected, rtol=1e-6, atol=1e-9
    )
    np.testing.assert_array_equal(whiten(covariance, deviation[..., 0]), white[..., 0])
    covariance[7, 2] = covariance[7, 1]
    with pytest.raises(np.linalg.LinAlgError):
        whiten(-covariance, deviation)


@pytest.mark.parametrize("assets", [1, 1000, 6000, 20_000])
@pytest.mark.parametrize("begin", [START, START + 211.7])
def test_assets_that_begin_together_are_examined_one_after_the_other(assets: int, begin: float) -> None:
    settings, found = DiagnosisSettings(), undetermined("none").model_copy(update={"verdict": "healthy"})
    times: list[list[float]] = [[], [], []]
    for phase in np.random.default_rng(1).permutation((np.arange(assets) + 0.5) / assets).tolist():
        state = ExaminationState.begin(begin, settings, phase, assets)
        for each in times:
            t = state.due
            each.append(t - begin)
            early, nothing = update_examination(state, settings, t - 1e-3, False, lambda: found, phase)
            state, result = update_examination(state, settings, t, False, lambda: found, phase)
            assert (early, nothing, result) == (early, None, found)
            assert settings.every_s / 2.0 <= state.due - t <= 1.5 * settings.every_s
    first, second, third = map(np.array, times)
    span = min(max(assets / FIRST_PER_S, settings.window_s), settings.every_s)
    assert settings.window_s <= first.min() and first.max() <= settings.window_s + span
    np.testing.assert_allclose(third, second + settings.every_s, atol=1e-5)  # at their places from then on
    if span == settings.every_s:
        np.testing.assert_allclose(second, first + settings.every_s, atol=1e-5)
    most = max(assets / span, assets / settings.every_s)
    for several in (first, np.concatenate([second, third])):
        assert np.bincount((several // 30.0).astype(int)).max() <= 30.0 * most + 2.0


def test_a_clock_that_is_set_back_does_not_put_off_the_first_examination() -> None:
    settings = DiagnosisSettings()
    state = ExaminationState.begin(START, settings, 0.25)
    early = START - YEAR
    assert not is_at_rest(state, early, False)
    earlier, found = update_examination(state, settings, early, False, lambda: undetermined("none"))
    assert found is None and earlier.due - early == state.due - START <= 2.0 * settings.window_s
    assert is_at_rest(earlier, early + 1.0, False)
