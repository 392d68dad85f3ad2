"""What the service is made of: blocks, replay, arrival, checkpoints, verdicts, one asset; each by itself."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import halls
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servoscope.core.errors import AlarmError, ConfigError, RecordingError, StateError
from servoscope.core.messages import text_message
from servoscope.core.verdict import VerdictKind
from servoscope.diagnosis.monitor import Monitor
from servoscope.diagnosis.schedule import DiagnosisSchedule
from servoscope.service.alarms import AlarmSettings, LifecycleEvent, LifecycleState, OperatorCommand
from servoscope.service.assets import checkpoint
from servoscope.service.assets.asset import Asset, AssetPolicy
from servoscope.service.assets.examination import StoredDiagnosis, diagnose_blocks
from servoscope.service.assets.examination_schedule import (
    ExaminationState,
    PendingDiagnosis,
    schedule_full_diagnosis,
    update_examination,
)
from servoscope.service.assets.residual_history import HistoryState, update_history
from servoscope.service.build import check_service_file
from servoscope.service.config import DiagnosisSettings, ServiceFile
from servoscope.service.sources.block import Block, ResumePosition
from servoscope.service.sources.replay import ReplaySettings, ReplayStream, ReplayTransport
from servoscope.service.store.queries import format_time
from servoscope.signals import Recording
from servoscope.signals.quality import QualitySettings
from servoscope.signals.timebase import Timebase
from servoscope.simulation import FaultEvent

BEGAN = 1.7e9
SETTINGS = DiagnosisSettings(window_s=40.0, every_s=100.0)
HOW = AssetPolicy(SETTINGS, QualitySettings(), AlarmSettings.model_validate({}), residual_every_s=1.0)


def tape(samples: int = 50, *, repeat: bool = False) -> ReplayStream:
    return ReplayStream((halls.recorded(1), halls.recorded(2, halls.LEAK)), samples, repeat)


def asset(how: AssetPolicy = HOW) -> Asset:
    return Asset("press", halls.baseline(), Monitor(halls.baseline()), how)


def blocks(recording: Recording, samples: int = 50) -> list[Block]:
    one = ReplayStream((recording,), samples, repeat=False)
    found = (one.block("press", k, BEGAN) for k in range(math.ceil(recording.samples / samples)))
    return [block for block in found if block is not None]


class TestReplay:
    def test_every_sample_is_in_one_block(self) -> None:
        cut = [block for k in range(400) if (block := tape(37).block("press", k, BEGAN)) is not None]
        whole = np.concatenate([block.signals for block in cut], axis=1)
        for row, name in zip(whole[1:], "ruy", strict=True):
            assert (row == np.concatenate([getattr(one, name) for one in tape().recordings])).all()
        steps = np.diff(whole[0])
        assert np.flatnonzero(steps > 0.015).tolist() == [5999]  # a gap where the second recording begins
        assert tape(37).block("press", len(cut), BEGAN) is None

    def test_rounds_repeat_all_but_the_time(self) -> None:
        first, again = (tape(repeat=True).block("press", k, BEGAN) for k in (7, 240 + 7))
        assert first is not None and again is not None
        assert (first.signals[1:] == again.signals[1:]).all()
        assert np.ptp(again.t - first.t) < 1e-5 and again.t[0] - first.t[0] == pytest.approx(120.02)

    def test_it_goes_on_where_it_was_told_in_the_order_of_time(self, tmp_path: Path) -> None:
        halls.files(tmp_path)
        loop = halls.baseline().loop
        settings = ReplaySettings(kind="replay", speed=0.0, block=1.0)
        source = ReplayTransport(settings, {name: ((tmp_path / "healthy.csv",), loop) for name in ("a", "b")})
        source.open({"a": ResumePosition(9, BEGAN), "b": ResumePosition(11, BEGAN)})
        order = [(one.content.asset, one.content.sequence) for one in source.receive(5)]
        assert order == [("a", 10), ("a", 11), ("a", 12), ("b", 12), ("a", 13)]
        while source.receive(50):
            pass
        assert math.isinf(source.next_message_s)

    def test_it_keeps_time(self, tmp_path: Path) -> None:
        halls.files(tmp_path)
        settings = ReplaySettings(kind="replay", speed=2.0, block=30.0)
        source = ReplayTransport(settings, {"a": ((tmp_path / "healthy.csv",), halls.baseline().loop)})
        source.open({})
        assert source.receive(1) == []
        assert 14.0 < source.next_message_s < 15.0  # a block of 30 s, twice as fast as it was recorded


@pytest.mark.parametrize(
    ("t", "used", "restart"),
    [
        ([1.0, 1.01, 1.02], [1, 1, 1], [0, 0, 0]),
        ([1.0, 1.01, 1.05], [1, 1, 1], [0, 0, 1]),  # a gap
        ([1.0, 1.0, 1.01], [1, 0, 1], [0, 0, 0]),  # repeated
        ([1.0, 0.98, 1.01], [1, 0, 1], [0, 0, 0]),  # late
        ([1.0, 1.01, 0.5], [1, 1, 1], [0, 0, 1]),  # the clock was set back
        ([1.0, math.nan, 1.01], [1, 0, 1], [0, 0, 0]),
        ([0.99, 1.0, 1.01], [0, 1, 1], [0, 0, 0]),  # repeats the block before
    ],
)
def test_what_of_a_block_counts(t: list[float], used: list[int], restart: list[int]) -> None:
    found = Timebase(0.01).order_block(np.array(t), 0.99)
    assert found.rows.tolist() == [row for row, x in enumerate(used) if x]
    assert found.restart.tolist() == [bool(x) for x, y in zip(restart, used, strict=True) if y]
    assert found.t == [x for x, yes in zip(t, used, strict=True) if yes][-1]


@pytest.fixture(scope="module")
def packed() -> bytes:
    """A checkpoint of an asset behind 45 s."""
    followed = asset()
    for block in blocks(halls.recorded(1))[:90]:
        followed.process(block)
    assert followed.state is not None
    return checkpoint.pack_state(followed.state)


class TestCheckpoint:
    def test_it_is_turned_back_whole(self, packed: bytes) -> None:
        assert checkpoint.pack_state(checkpoint.unpack_state(packed, "press")) == packed

    @given(where=st.floats(0.0, 1.0, exclude_max=True), bit=st.integers(0, 7))
    def test_one_bit_is_enough_to_refuse_it(self, packed: bytes, where: float, bit: int) -> None:
        torn = bytearray(packed)
        torn[int(where * len(torn))] ^= 1 << bit
        with pytest.raises(StateError, match=r"press: its saved state is .*run --anew press"):
            checkpoint.unpack_state(bytes(torn), "press")

    @given(share=st.floats(0.0, 1.0, exclude_max=True))
    def test_so_is_a_torn_one(self, packed: bytes, share: float) -> None:
        with pytest.raises(StateError, match="torn: restore the store from a copy"):
            checkpoint.unpack_state(packed[: int(share * len(packed))], "press")

    def test_another_version_is_named(self, packed: bytes) -> None:
        other = packed[:16] + (checkpoint.VERSION + 1).to_bytes(2, "little") + packed[18:]
        with pytest.raises(
            StateError, match=r"is of version 2, this servoscope reads 1: use the version that wrote it"
        ):
            checkpoint.unpack_state(other, "press")

    def test_another_baseline_or_size_is_refused(self, packed: bytes) -> None:
        for change, text in (({"baseline": "0"}, "another baseline"), ({"monitor": np.zeros(3)}, "another servoscope")):
            with pytest.raises(StateError, match=rf"{text} .* run --anew press"):
                asset().resume(replace(checkpoint.unpack_state(packed, "press"), **change), [])


def result(verdict: VerdictKind, onset: float | None = None, **values: Any) -> StoredDiagnosis:
    return StoredDiagnosis(verdict=verdict, headline=text_message("words"), onset=onset, **values)


class TestJudging:
    settings, schedule = DiagnosisSettings(window_s=40.0, every_s=100.0), DiagnosisSchedule(40.0, 10.0)

    def course(self, exceeded: list[bool], verdict: VerdictKind = "healthy") -> list[int]:
        """Return at which seconds there was an examination that says the verdict."""
        state, looked = ExaminationState(due=1e9, verdict="healthy"), []
        for t, above in enumerate(exceeded):
            state, found = update_examination(state, self.settings, float(t), above, lambda: result(verdict))
            looked += [t] if found else []
        return looked

    def test_a_deviation_that_nothing_confirms_is_looked_at_less_and_less(self) -> None:
        assert self.course([False] * 5 + [True] * 95) == [5, 6, 8, 12, 20, 36, 68]

    def test_one_that_is_confirmed_is_looked_at_once(self) -> None:
        assert self.course([False] * 5 + [True] * 50, "fault") == [5]

    def test_the_beginning_of_a_fault_stays_what_it_was_first_seen_to_be(self) -> None:
        first, _ = update_examination(
            ExaminationState(due=0.0), self.settings, 10.0, True, lambda: result("fault", 8.0)
        )
        later, _ = update_examination(
            replace(first, due=20.0), self.settings, 20.0, True, lambda: result("fault", 15.0)
        )
        over, _ = update_examination(replace(later, due=30.0), self.settings, 30.0, False, lambda: result("healthy"))
        assert (first.onset, later.onset, over.onset) == (8.0, 8.0, None)

    def test_a_fault_that_stands_is_diagnosed_again_each_time_it_is_twice_as_old(self) -> None:
        state, asked = ExaminationState(due=0.0, verdict="healthy"), []
        for t in range(10, 2000):
            state, found = update_examination(state, self.settings, float(t), True, lambda: result("fault", 8.0))
            state, in_full = schedule_full_diagnosis(state, self.schedule, float(t)) if found else (state, False)
            asked += [t] if in_full else []
        assert asked[0] == 10 and asked[1] >= 50  # with the window full of it
        assert all(2 * (a - 10) <= b - 10 <= 2 * (a - 10) + 150 for a, b in pairwise(asked[1:])) and len(asked) == 6
        assert schedule_full_diagnosis(replace(state, again=1e9, since=0.0), self.schedule, 1e6)[1] is False
        late, in_full = schedule_full_diagnosis(replace(state, since=0.0), self.schedule, 1e6)
        assert in_full and late.again == 1e6 + 86400.0

    def test_quiet_assets_are_looked_at_now_and_then(self) -> None:
        state, found = update_examination(
            ExaminationState(due=50.0), self.settings, 51.0, False, lambda: result("healthy")
        )
        assert found is not None and (state.verdict, state.since, state.due) == ("healthy", 51.0, 200.0)

    def test_after_a_deviation_the_window_has_to_pass(self) -> None:
        gone = result("undetermined", recovering=True)
        state, _ = update_examination(
            ExaminationState(due=1e9, verdict="fault"), self.settings, 10.0, False, lambda: gone
        )
        assert state.due == 50.0


def test_stored_residuals_do_not_depend_on_how_the_blocks_are_cut() -> None:
    monitor, recording = Monitor(halls.baseline()), halls.recorded(2, halls.LEAK)

    def rows(cuts: list[int]) -> list[dict[str, object]]:
        state, found, thinned = monitor.init(), [], HistoryState()
        for a, b in pairwise([0, *cuts, 6000]):
            state, trace = monitor.run(state, recording.r[a:b], recording.u[a:b], recording.y[a:b])
            thinned, more = update_history(thinned, trace, BEGAN + trace.t, 2.5)
            found += more
        return found

    whole = rows([])
    assert len(whole) == 23 and max(row["statistic"] for row in whole) > 5.0  # type: ignore[type-var,operator]
    assert rows([1, 7, 777, 2000, 2001, 5990]) == whole
    # cut where a period begins: that evaluation is the last of its block, and makes one row all the same
    ends = [round((row["t"] - BEGAN) * 100.0) + 1 for row in whole]  # type: ignore[operator]
    assert rows(ends) == whole


class TestAsset:
    def test_a_block_counts_once(self) -> None:
        one, other, cut = asset(), asset(), blocks(halls.recorded(1))[:20]
        for block in cut:
            one.process(block)
            other.process(block)
            assert other.process(block).rows == []
        assert one.state is not None and other.state is not None
        assert other.state.position == replace(one.state.position, repeated=20)
        assert (other.state.monitor == one.state.monitor).all()

    def test_a_block_that_is_missing_is_told(self) -> None:
        followed, cut = asset(), blocks(halls.recorded(1))[:20]
        told = [row for block in (*cut[:8], *cut[11:]) for row in followed.process(block).rows if row.table == "audit"]
        (lost,) = told
        assert lost.values["document"] == {"blocks": 3, "after": [0, 7], "before": [0, 11]}
        assert followed.state is not None and followed.state.position.lost == 3

    def test_what_is_no_block_is_refused(self) -> None:
        followed, block = asset(), blocks(halls.recorded(1))[0]
        nothing = block.t[:0]
        for wrong in (
            replace(block, t=nothing, r=nothing, u=nothing, y=nothing),
            replace(block, y=block.y[1:]),
            replace(block, t=np.full(50, math.nan)),
        ):
            with pytest.raises(RecordingError, match="press: block 0: t, r, u, y must have one length"):
                followed.process(wrong)
        assert followed.state is None

    def test_a_clock_that_is_set_back_keeps_neither_samples_nor_verdicts_waiting(self) -> None:
        followed = asset()
        for k, block in enumerate(blocks(halls.recorded(1, seconds=600.0))):
            followed.process(replace(block, t=block.t - (3600.0 if k >= 200 else 0.0)))
        assert followed.state is not None
        assert len(followed._window) <= 2 * 40 / 0.5 + 1
        assert followed.state.examination.examined is not None
        assert followed.state.examination.examined < BEGAN - 3000.0

    def test_what_is_no_number_does_no_harm(self) -> None:
        followed, cut = asset(), blocks(halls.recorded(1))[:40]
        for k, block in enumerate(cut):
            y = np.where(np.arange(50) % 7 == k % 7, [math.inf, math.nan] * 25, block.y)
            followed.process(replace(block, y=y) if 10 < k < 20 else block)
        assert followed.state is not None
        checkpoint.unpack_state(checkpoint.pack_state(followed.state), "press")
        assert math.isfinite(followed.state.evaluation.status.statistic or math.nan)

    def test_silence_is_an_alarm_and_no_verdict(self) -> None:
        followed = asset()
        for block in blocks(halls.recorded(1)):
            followed.process(block)
        assert followed.state is not None
        assert followed.status(followed.state)["verdict"] == "healthy"
        told = [one for quiet in range(1, 40) for one in followed.advance_time(float(quiet)).transitions]
        status = followed.status(followed.state)
        assert status["verdict"] == "undetermined" and "silent" in status["quality"]
        (alarm,) = [one for one in told if one.after is LifecycleState.UNACKNOWLEDGED]
        assert (alarm.alarm, alarm.cause) == ("data_quality", "no data come")
        assert status["summary"] == "Undetermined: no data come."
        assert status["ne107"] == "failure"

    def test_a_fault_is_alarmed_and_then_diagnosed_in_full(self) -> None:
        followed, transitions = asset(), []
        for block in blocks(halls.recorded(2, halls.LEAK))[:90]:
            transitions += followed.process(block).transitions
        (alarm,) = transitions
        assert alarm.alarm == "fault" and BEGAN + 30.0 < alarm.time < BEGAN + 33.0
        ((window, seen),) = followed.due_diagnoses()
        assert window.until == alarm.time + 10.0 and seen[-1].t[-1] >= window.until - 0.02
        assert [len(found) for _, found in followed.due_diagnoses(ended=True)] == [len(seen)]
        with pytest.raises(AlarmError, match="reset means nothing there"):
            followed.execute("fault", OperatorCommand(LifecycleEvent.RESET, "ann"))
        (done,) = followed.execute("fault", OperatorCommand(LifecycleEvent.ACKNOWLEDGE, "ann", "seen")).transitions
        assert (done.after, done.who, done.cause) == (LifecycleState.ACKNOWLEDGED, "ann", "seen")
        with pytest.raises(AlarmError, match=r"press: has no alarm 'falt', did you mean 'fault'\?"):
            followed.execute("falt", OperatorCommand(LifecycleEvent.ACKNOWLEDGE, "ann"))

    def test_a_fault_that_grows_is_diagnosed_in_full_again(self) -> None:
        followed, told, onsets = asset(), list[tuple[float, bool, float]](), list[float]()
        grown = FaultEvent.parse("C_ie=1.6@200")
        for block in blocks(halls.recorded(3, halls.LEAK, grown, seconds=400.0)):
            followed.process(block)
            for window, seen in followed.due_diagnoses():
                said = diagnose_blocks(followed.machine, "press", seen)
                (fault,) = said.document["faults"]
                told.append((window.until - BEGAN, followed.is_news(window, said), fault["ratio"]))
                row = followed.apply_diagnosis(window, said).rows[0]
                onsets.append(row.values["onset"])
                assert f"since {format_time(onsets[0])} UTC" in row.values["summary"]
        assert [news for _, news, _ in told] == [True, False, False]  # the same fault: nobody is told once more
        assert [size for *_, size in told] == pytest.approx([1.2, 1.2, 1.6], abs=0.01)
        assert followed.state is not None
        status = followed.status(followed.state)
        (fault,) = status["faults"]
        assert (
            status["summary"] == status["alarms"]["fault"]["cause"] and "leakage has risen by 60 %" in status["summary"]
        )
        assert fault["ratio"] == told[-1][2] and followed.state.examination.onset == onsets[0]
        assert onsets == [onsets[0]] * 3 and onsets[0] == pytest.approx(BEGAN + 30.0, abs=0.5)
        other = result("fault", document={"faults": [{"name": "pump", "ratio": 0.9}]})
        nothing = result("fault", document={"faults": []})
        late = PendingDiagnosis(99, 0, BEGAN + 400.0, "full")
        assert followed.is_news(late, other) and not followed.is_news(late, nothing)
        # once it has gone the alarm still says what it was
        for block in blocks(halls.recorded(1, seconds=120.0)):
            followed.process(replace(block, sequence=block.sequence + 1000, t=block.t + 401.0))
        status = followed.status(followed.state)
        assert status["verdict"] == "healthy" and status["summary"].startswith("Healthy")
        assert status["alarms"]["fault"]["state"] == "latched_unacknowledged"
        assert "leakage has risen by 60 %" in status["alarms"]["fault"]["cause"]


class TestConfig:
    @pytest.mark.parametrize(
        ("old", "new", "said"),
        [
            ("speed =", "sped =", "[sources] line.sped: unknown key, did you mean 'speed'?"),
            ("window_s = 40.0", "window_s = 0", "[diagnosis] window_s: 0 must be at least 0.001"),
            ('source = "line"', 'source = "lime"', "there is no source 'lime', only line"),
            (
                'kind = "replay"',
                'kind = "mqt"',
                "[sources] line.kind: 'mqt' is unknown, choose from folder, kafka, mqtt, opcua, replay",
            ),
            ('kind = "replay"', "", "[sources] line.kind: missing, choose from folder, kafka, mqtt, opcua, replay"),
            (
                'kind = "replay"',
                'kind = "mqtt"',
                "[sources] line.speed: unknown key, choose from kind, network, ca_file",
            ),
            ('name = "hall"', 'name = "press"', "'press' is an asset's name too"),
            ("[store]", "[stor]", "stor: unknown key, did you mean 'store'?"),
            (
                "start = 2026-01-01T00:00:00Z",
                "start = 2026-01-01T00:00:00",
                "line.start: 2026-01-01T00:00:00 has no time zone",
            ),
            ("[assets.press]", '[assets."press 1"]', "[assets] press 1: 'press 1' is no name: letters, digits, _ and"),
            (
                'listen = ""',
                'listen = "localhost"',
                "[service] listen: 'localhost' is no address, write \"127.0.0.1:9464\"",
            ),
            ('listen = ""', 'listen = "localhost:99999"', "'localhost:99999' is no address"),
            ('name = "hall"', "name = hall", "not valid TOML"),
        ],
    )
    def test_a_mistake_is_one_line_with_its_key(self, tmp_path: Path, old: str, new: str, said: str) -> None:
        path = halls.hall(tmp_path, "wrong")
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new, 1))
        with pytest.raises(ConfigError) as caught:
            ServiceFile.load(path)
        assert said in str(caught.value) and str(path) in str(caught.value) and "\n" not in str(caught.value)

    def test_a_missing_baseline_says_whose(self, tmp_path: Path) -> None:
        with pytest.raises(
            ConfigError, match=r"^\[assets\] press.baseline: .*baseline.json: no such file; make a basel"
        ):
            check_service_file(ServiceFile.load(halls.hall(tmp_path, "bare")))

    def test_a_missing_file_says_so(self, tmp_path: Path) -> None:
        with pytest.raises(ConfigError, match="no such file"):
            ServiceFile.load(tmp_path / "none.toml")
