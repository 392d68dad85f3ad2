"""Data quality: each defect is found and named, sound data are not, and cutting the stream changes nothing."""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import RecordingError, StateError
from servoscope.models.loop import Loop
from servoscope.service.alarms import AssetSnapshot, evaluate_condition
from servoscope.service.alarms.settings import AlarmSettings
from servoscope.signals.quality import (
    KINDS,
    QualityFinding,
    QualitySettings,
    active_findings,
    check_block,
    init_state,
    limit_verdict,
    restart_silence,
    tick,
    upgrade_state,
)
from servoscope.signals.readers import read

EPOCH = 1.7e9  # s: a time stamp of our days, whose last digit is 2.4e-7 s
LIMITS = QualitySettings().limits(100.0)


class Block(NamedTuple):
    """A minute of an axis that moves for 20 s, rests for 20 s and moves again, with a controller."""

    t: FloatArray
    r: FloatArray
    u: FloatArray
    y: FloatArray


def axis(noise: float = 1e-3, step: float = 0.0, n: int = 6000, seed: int = 1) -> Block:
    rng = np.random.default_rng(seed)
    time = np.arange(n) / 100.0
    r = np.where((time < 20.0) | (time >= 40.0), np.sin(2.0 * np.pi * 0.2 * time), 0.0)
    true = np.convolve(r, np.ones(20) / 20)[:n]
    y = true + noise * rng.standard_normal(n)
    if step:
        y = step * np.round(y / step)
    return Block(EPOCH + time, r, 5.0 * (r - y) + np.gradient(true), y)


def found(block: Block, limits: object = LIMITS) -> list[tuple[str, bool]]:
    _, findings = check_block(limits, init_state(), *block)  # type: ignore[arg-type]
    return [(one.kind, one.begins) for one in findings]


SOUND = [("waiting", False)]


@pytest.mark.parametrize(
    "block",
    [
        axis(),
        axis(noise=0.0),
        axis(noise=1e-3, step=0.02),
        axis(noise=0.0, step=0.02),
        axis(noise=1e-2, step=0.02),
        axis()._replace(u=np.clip(axis().u, -0.2, 0.2)),
    ],
    ids=["noise", "no noise", "coarse, noise below a step", "coarse, no noise", "coarse, noise of a step", "limited u"],
)
def test_sound_data_are_sound_moving_or_at_rest(block: Block) -> None:
    assert found(block) == SOUND


def test_rest_from_the_start_is_sound_whatever_the_sensors() -> None:
    block, k = axis(noise=0.0), np.arange(6000)
    between_two_steps = np.where(k < 4000, 0.02 * (k % 2), 0.0)
    for y in (np.zeros(6000), np.where(k % 997 == 0, 0.02, 0.0), between_two_steps):
        assert found(block._replace(r=np.zeros(6000), u=np.zeros(6000), y=y)) == SOUND


@pytest.mark.parametrize("channel", ["y", "u"])
@pytest.mark.parametrize("step", [0.0, 0.02])
def test_a_frozen_channel_is_found_while_the_motion_demands_a_change_and_ends_with_it(
    channel: str, step: float
) -> None:
    block = axis(step=step)
    values = getattr(block, channel).copy()
    values[4200:5500] = values[4200]
    assert found(block._replace(**{channel: values})) == [
        *SOUND,
        (f"frozen_{channel}", True),
        (f"frozen_{channel}", False),
    ]


@pytest.mark.parametrize("logged", ["u itself", "constant", "a plan"])
def test_a_staircase_that_nobody_controls_is_not_frozen(logged: str) -> None:
    """A jog or an experiment in open loop holds u for ten seconds; y goes on moving, and so does r - y."""
    time = np.arange(12000) / 100.0
    u = np.repeat(np.random.default_rng(1).normal(size=12), 1000)
    y = np.cumsum(u) / 100.0 + 1e-3 * np.random.default_rng(2).normal(size=12000)
    r = {"u itself": u, "constant": np.zeros(12000), "a plan": np.sin(time)}[logged]
    assert found(Block(EPOCH + time, r, u, y)) == SOUND


def test_no_reference_or_one_that_is_u_itself_says_nothing_of_u() -> None:
    """u changes at each sample until a hand holds it."""
    block = axis(n=12000)
    block.u[8000:9500] = 0.1
    for r in (block.u, np.zeros(12000)):
        assert ("frozen_u", True) not in found(block._replace(r=r))
    assert ("frozen_u", True) in found(block)


def test_a_state_of_version_1_goes_on() -> None:
    """It held no changes of u: one that is stuck is found once enough have been counted."""
    block = axis()
    block.u[4200:5500] = block.u[4200]
    half = Block(*(x[:1000] for x in block)), Block(*(x[1000:] for x in block))
    state = check_block(LIMITS, init_state(), *half[0])[0]
    old = np.concatenate([[1.0], state[1:-2]])
    with pytest.raises(StateError, match="another version"):
        check_block(LIMITS, old, *half[1])
    findings = check_block(LIMITS, upgrade_state(old), *half[1])[1]
    assert [(one.kind, one.begins) for one in findings] == [("frozen_u", True), ("frozen_u", False)]
    assert upgrade_state(state) is state


def test_a_controller_at_its_limit_is_not_frozen() -> None:
    block = axis()
    block.u[4200:5500] = block.u.max()
    assert found(block) == SOUND


def test_a_sensor_that_is_dead_from_the_start_is_found() -> None:
    assert found(axis()._replace(y=np.zeros(6000))) == [("frozen_y", True), *SOUND]


def test_a_frozen_value_is_found_at_rest_where_the_sensor_is_known_to_be_noisy() -> None:
    long = axis(n=12000)
    rest = Block(long.t, np.zeros(12000), long.u, long.y - long.r)
    rest.y[8000:] = rest.y[8000]
    assert found(rest) == [*SOUND, ("frozen_y", True)]
    coarse = rest._replace(y=0.02 * np.round(rest.y / 0.02))
    assert found(coarse) == SOUND


def test_a_spike_does_not_blind_for_long() -> None:
    limits = QualitySettings(window_s=2.0).limits(100.0)
    block = axis(noise=0.0, n=2 * 60 * 200 + 6000)
    block.y[100] = 1e6
    block.y[-3000:] = block.y[-3000]
    block.r[-3000:] = np.sin(np.arange(3000) / 100.0)
    assert ("frozen_y", True) in found(block, limits)


def without(block: Block, start: int, stop: int) -> Block:
    return Block(*(np.delete(signal, slice(start, stop)) for signal in block))


def test_missing_samples_are_a_gap_until_a_window_is_whole_again() -> None:
    block = without(axis(), 2500, 2540)
    _, findings = check_block(LIMITS, init_state(), *block)
    begin, end = findings[1:]
    assert (begin.kind, begin.begins, begin.time) == ("gap", True, EPOCH + 25.40)
    assert begin.value == pytest.approx(40 / 1040)
    assert (end.kind, end.begins) == ("gap", False)
    assert found(without(axis(), 2500, 2510)) == SOUND  # 1 % is allowed
    nan = axis()
    nan.y[2500:2540] = np.nan
    assert found(nan) == [*SOUND, ("gap", True), ("gap", False)]


@pytest.mark.parametrize("jump", [3600.0, -3600.0, -0.5])
def test_a_clock_that_is_set_is_found_until_a_window_is_whole_again(jump: float) -> None:
    block = axis()
    block.t[2500:] += jump
    _, findings = check_block(LIMITS, init_state(), *block)
    assert [(one.kind, one.begins) for one in findings] == [*SOUND, ("clock", True), ("clock", False)]
    assert findings[1].value == pytest.approx(jump + 0.01, abs=1e-6)


def test_a_long_step_of_the_stamps_is_a_gap_if_the_silence_was_heard() -> None:
    block = axis()
    state, _ = check_block(LIMITS, init_state(), *(signal[:2000] for signal in block))
    state, _ = tick(LIMITS, state, 100.0)
    state, findings = tick(LIMITS, state, 110.5)
    assert findings == (QualityFinding("silent", True, 110.5, 10.5, 10.0),)
    assert list(active_findings(state)) == ["silent"]
    state, findings = check_block(LIMITS, state, *(signal[4000:] for signal in block))
    assert [one.kind for one in findings if one.begins] == ["gap"]
    state, findings = tick(LIMITS, state, 120.0)
    assert findings == (QualityFinding("silent", False, 120.0, 0.0, 10.0),)


def test_silence_before_the_first_sample_is_silence_and_that_of_the_service_is_not() -> None:
    state, findings = tick(LIMITS, init_state(), 50.0)
    state, findings = tick(LIMITS, state, 61.0)
    assert [one.kind for one in findings] == ["silent"]
    block = axis()
    state, _ = check_block(LIMITS, init_state(), *block)
    state, _ = tick(LIMITS, state, 50.0)
    assert tick(LIMITS, restart_silence(state, 900.0), 901.0)[1] == ()


def test_jitter_and_a_wrong_sample_rate_are_found() -> None:
    rng = np.random.default_rng(5)
    block = axis()
    shaken = block._replace(t=block.t + rng.uniform(-0.0015, 0.0015, 6000))
    assert found(shaken) == [("jitter", True), *SOUND]
    late = block._replace(t=block.t + 0.007 * (np.arange(6000) % 50 == 0))
    assert found(late) == SOUND
    slight = block._replace(t=block.t + rng.uniform(-0.0005, 0.0005, 6000))
    assert found(slight) == SOUND
    slow = block._replace(t=EPOCH + 1.003 * (block.t - EPOCH))
    _, findings = check_block(LIMITS, init_state(), *slow)
    assert findings[0].kind == "rate"
    assert findings[0].value == pytest.approx(1 / 1.003 - 1, abs=1e-6)
    assert found(block._replace(t=EPOCH + 1.001 * (block.t - EPOCH))) == SOUND


def damaged() -> Block:
    """Return a stream with everything in it."""
    block = axis(n=9000, seed=7)
    block.y[4200:5000] = block.y[4200]
    block.u[5200:6000] = block.u[5200]
    block.y[700:760] = np.nan
    block.t[3000] = np.nan
    block.t[6500:] -= 100.0
    block.t[7000:7800] += np.random.default_rng(3).uniform(-0.004, 0.004, 800)
    return without(block, 1500, 1700)


@settings(max_examples=40)
@given(cuts=st.lists(st.integers(0, 8800), max_size=12))
def test_cutting_the_stream_anywhere_changes_nothing(cuts: list[int]) -> None:
    block = damaged()
    whole, expected = check_block(LIMITS, init_state(), *block)
    assert {one.kind for one in expected if one.begins} == {"gap", "frozen_y", "frozen_u", "clock", "jitter"}
    state, findings = init_state(), []
    for part in zip(*(np.split(signal, sorted(cuts)) for signal in block), strict=True):
        state, told = check_block(LIMITS, state, *part)
        findings += told
        state = np.array(json.loads(json.dumps(state.tolist(), allow_nan=False)))
    assert tuple(findings) == expected
    assert np.array_equal(state, whole)


def test_sample_by_sample_is_the_same_too_and_the_old_state_stays_valid() -> None:
    block = Block(*(signal[:1500] for signal in damaged()))
    begin = init_state()
    whole, expected = check_block(LIMITS, begin, *block)
    state, findings = begin, []
    for k in range(1500):
        state, told = check_block(LIMITS, state, *(signal[k : k + 1] for signal in block))
        findings += told
    assert tuple(findings) == expected
    assert np.array_equal(state, whole)
    assert np.array_equal(begin, init_state())


def test_more_findings_than_fit_at_a_time_are_all_told() -> None:
    block = axis()
    block.t[1::2] -= 100.0
    assert sum(one.kind == "clock" for one in check_block(LIMITS, init_state(), *block)[1]) == 5999


def test_nothing_is_healthy_by_default() -> None:
    assert list(active_findings(init_state())) == ["waiting"]
    assert limit_verdict("healthy", active_findings(init_state())) == "undetermined"
    state, _ = check_block(LIMITS, init_state(), *(signal[:900] for signal in axis()))
    assert limit_verdict("healthy", active_findings(state)) == "undetermined"
    state, _ = check_block(LIMITS, init_state(), *axis())
    assert limit_verdict("healthy", active_findings(state)) == "healthy"
    assert [kind for kind in KINDS if limit_verdict("healthy", [kind]) != "undetermined"] == []
    assert [kind for kind in KINDS if limit_verdict("fault", [kind]) == "fault"] == ["gap"]


def test_a_stream_without_a_single_good_step_stays_unknown() -> None:
    block = axis()._replace(t=np.full(6000, np.nan))
    state, _ = check_block(LIMITS, init_state(), *block)
    assert {"waiting", "gap"} == set(active_findings(state))


def test_every_finding_alarms_and_says_what_it_is() -> None:
    quality = AlarmSettings().asset_alarms["data_quality"]
    for kind in KINDS:
        assert evaluate_condition(quality, False, AssetSnapshot(quality=(kind,))) == (
            "unknown" if kind == "waiting" else "abnormal"
        )
        message = QualityFinding(kind, True, 0.0, 0.25, 5.0).message
        assert message and "{" not in message


def test_blocks_that_do_not_fit_and_states_of_another_version_are_refused() -> None:
    with pytest.raises(RecordingError, match="same shape"):
        check_block(LIMITS, init_state(), [0.0], [0.0, 1.0], [0.0], [0.0])
    old = init_state()
    old[0] = 99.0
    for state in (old, init_state()[:-1]):
        with pytest.raises(StateError, match="another version"):
            tick(LIMITS, state, 0.0)


def test_measured_recordings_are_sound_and_a_sensor_frozen_in_one_is_found(shared_data: Path, project: Path) -> None:
    for name, path in (("emps", "real/emps/DATA_EMPS.mat"), ("eha-pump", "real/eha_pump/exp_data_1_4.csv")):
        loop = Loop.load(project / "examples" / f"{name}.toml")
        recording = read(shared_data / path, loop)
        limits = QualitySettings().limits(loop.sample_rate)
        block = Block(EPOCH + recording.t, recording.r, recording.u, recording.y.copy())
        assert found(block, limits) == SOUND
        block.y[10000:18000] = block.y[10000]
        assert ("frozen_y", True) in found(block, limits)
