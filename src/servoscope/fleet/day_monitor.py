"""One asset's day, block by block: the pure step (state, rows) -> (state, evaluations) that every engine carries.

The monitor begins each day anew. Around the first alarm, or at the end of the day, a window of raw rows is diagnosed.
Results depend on the rows alone, not on how they were cut into blocks.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from servoscope.baseline.baseline import Baseline
from servoscope.core.arrays import BoolArray, FloatArray, IntArray
from servoscope.core.errors import ServoscopeError
from servoscope.core.verdict import VerdictKind
from servoscope.detection.covariate_monitor import fill_channels
from servoscope.detection.statistic import consecutive_exceedances
from servoscope.detection.trace import Trace
from servoscope.diagnosis.diagnose import diagnose_with_trace
from servoscope.diagnosis.monitor import Monitor
from servoscope.diagnosis.schedule import DiagnosisSchedule
from servoscope.fleet.common_cause import trace_evidence
from servoscope.fleet.rows import MICRO, Rows
from servoscope.signals.timebase import Timebase

WINDOW = 120.0  # s of raw rows that a diagnosis covers, unless the user chooses otherwise

_RowOrder = tuple[Rows, BoolArray]  # without repeated ones; which do not follow their predecessor by one sample period
RowLookup = Callable[[int, int], Rows]  # rows of the day with after < t <= to, in order


class EvaluationBlock(NamedTuple):
    """The evaluations of a block: time [us], theta (K, n), T^2, its limit, level."""

    time_us: IntArray
    theta: FloatArray
    statistic: FloatArray
    threshold: FloatArray
    level: FloatArray

    @classmethod
    def concatenate(cls, blocks: Iterable[EvaluationBlock]) -> EvaluationBlock:
        """Return the evaluations of several blocks, at least one, in their order."""
        return cls(*map(np.concatenate, zip(*blocks, strict=True)))


@dataclass(frozen=True, eq=False, kw_only=True)
class DayState:
    """What is kept of a day between two blocks."""

    monitor: FloatArray  # state of the monitor, shape (size,)
    samples: int = 0  # rows that the monitor has processed
    exceeding: int = 0  # the number of evaluations above a limit, without interruption until now
    baseline: str = ""  # hash of the one that it is followed with
    first_us: int | None = None  # first row of the day [us]
    last_us: int | None = None  # last row so far [us]
    repeats: int = 0  # rows with the time of an earlier one
    missing: int = 0  # rows with an empty cell
    gaps: int = 0
    evaluations: int = 0
    peak: float = 0.0  # largest statistic or level, as a multiple of its limit
    alarm_us: int | None = None  # first alarm [us]
    result: dict[str, Any] | None = None  # the diagnosis and its evidence, or the error; None until it is made

    def pack(self) -> bytes:
        """Return it as bytes: numbers as one line of JSON, then the monitor's array."""
        numbers = {("said" if key == "result" else key): value for key, value in vars(self).items() if key != "monitor"}
        return json.dumps(numbers).encode() + b"\n" + np.ascontiguousarray(self.monitor).tobytes()

    @classmethod
    def unpack(cls, content: bytes) -> DayState:
        """Return what `pack` packed."""
        line, _, array = content.partition(b"\n")
        numbers = json.loads(line)
        return cls(monitor=np.frombuffer(array, dtype=np.float64).copy(), result=numbers.pop("said"), **numbers)


@dataclass
class RowHistory:
    """The last rows of a day in memory, for engines that read a day in one go."""

    blocks: list[Rows] = field(default_factory=list)

    def drop_until(self, until_us: int) -> None:
        """Drop blocks without rows after a time."""
        self.blocks = [block for block in self.blocks if len(block) and block.t_us[-1] > until_us]

    def __call__(self, after_us: int, to_us: int) -> Rows:
        """Return the rows with after_us < t <= to_us."""
        return Rows.concatenate([block.between(after_us, to_us) for block in self.blocks])


class DayMonitor:
    """Follows days of assets of one baseline, which has its share of the fleet's budget of false alarms.

    `window_s`: seconds of raw rows that a diagnosis covers; a shorter day is diagnosed whole.
    """

    def __init__(self, baseline: Baseline, window_s: float = WINDOW) -> None:
        self.baseline = baseline
        self.monitor = Monitor(baseline)
        self._lane_key = self.monitor.lane_key
        self._window = round(window_s * MICRO)
        self._schedule = DiagnosisSchedule(self._window, self._window // 2)
        self._timebase = Timebase(MICRO / baseline.loop.sample_rate)

    def start(self) -> DayState:
        """Return the state before the first row of a day."""
        return DayState(monitor=self.monitor.init(), baseline=self.baseline.hash)

    def needed_since(self, state: DayState) -> int:
        """Return the time [us] up to which rows are not needed any more."""
        last = state.last_us if state.last_us is not None else 0
        return last if state.result is not None else last - self._window

    def advance(self, state: DayState, rows: Rows, history: RowLookup) -> tuple[DayState, EvaluationBlock]:
        """Process a block: rows in the order of time, after all earlier ones; the old state stays valid.

        `history`: rows of this day, those of the block included, as far back as `needed_since` requires.
        """
        (advanced,) = self.advance_lanes([DayStep(self, state, rows, history)])
        if isinstance(advanced, Exception):
            raise advanced
        return advanced

    def _order(self, state: DayState, rows: Rows) -> _RowOrder:
        """Return which rows are taken, and which of them do not follow their predecessors."""
        last = state.last_us if state.last_us is not None else rows.t_us[:1] - 10 * round(self._timebase.period)
        steps = np.diff(rows.t_us, prepend=last)
        repeated = self._timebase.is_repeat(steps)
        if repeated.any():
            steps, rows = steps[~repeated], rows[~repeated]
        return rows, self._timebase.is_gap(steps)

    def _judge(
        self, step: DayStep, ordered: _RowOrder, monitor: FloatArray, trace: Trace
    ) -> tuple[DayState, EvaluationBlock]:
        """Return what `advance` returns, of what the monitor has made of a block: its state, and its evaluations."""
        (_, state, rows, history), (taken, restart), first = step, ordered, step.state.last_us is None
        sample = np.rint(trace.t * self.baseline.loop.sample_rate).astype(np.int64) - state.samples
        exceeding = consecutive_exceedances(trace.exceeded, state.exceeding)
        alarms = np.flatnonzero(exceeding > self.monitor.pipeline.delays[0])
        limits = np.full(len(trace.t), self.baseline.thresholds.statistic)
        block = EvaluationBlock(taken.t_us[sample], trace.theta, trace.statistic, limits, trace.level)
        if not len(rows):
            return state, block
        peaks = np.maximum(trace.statistic / limits, trace.level)[trace.ready]
        empty = np.isnan(taken.r) | np.isnan(taken.u) | np.isnan(taken.y)
        new = replace(
            state,
            monitor=monitor,
            samples=state.samples + len(taken),
            exceeding=int(exceeding[-1]) if exceeding.size else state.exceeding,
            first_us=int(rows.t_us[0]) if first else state.first_us,
            last_us=int(rows.t_us[-1]),
            repeats=state.repeats + len(rows) - len(taken),
            missing=state.missing + int(empty.sum()),
            gaps=state.gaps + int(restart.sum()) - first,
            evaluations=state.evaluations + len(trace.t),
            peak=float(max(state.peak, peaks.max(initial=0.0))),
            alarm_us=int(block.time_us[alarms[0]]) if state.alarm_us is None and alarms.size else state.alarm_us,
        )
        if new.result is None and new.alarm_us is not None and new.last_us is not None:
            end = int(self._schedule.end(new.alarm_us, new.first_us))
            if new.last_us > end:
                new = replace(new, result=self._diagnose(new, end, history))
        return new, block

    def finish(self, state: DayState, history: RowLookup) -> DayState:
        """Return the state at the end of the day, with its result if there was any row."""
        if state.result is not None or state.last_us is None:
            return state
        return replace(state, result=self._diagnose(state, state.last_us, history))

    def _diagnose(self, state: DayState, end_us: int, history: RowLookup) -> dict[str, Any]:
        """Diagnose the window that ends there; return the error where that is impossible."""
        assert state.first_us is not None, "there was a row"
        # without an alarm features stay out: their limit over single windows is no part of the fleet's budget
        baseline = self.baseline if state.alarm_us is not None else self.baseline.model_copy(update={"features": None})
        rows = history(max(end_us - self._window, state.first_us - 1), end_us)
        known, now = self.monitor.covariate_history(state.monitor), state.last_us or 0
        rows = replace(rows, channels=fill_channels(rows.channels, (rows.t_us - now) / MICRO, known))
        try:
            recording = rows.to_recording(state.first_us, self.baseline.loop, "window")
            before: VerdictKind = "undetermined" if state.alarm_us is None else "suspect"  # an alarm has lasted
            diagnosis, trace = diagnose_with_trace(baseline, recording, before=before)
        except ServoscopeError as error:
            return {"error": str(error).removeprefix("window: ")}
        evidence = json.dumps(asdict(trace_evidence(self.baseline, trace)))
        document = diagnosis.model_dump_json(exclude={"recording"})
        return {"diagnosis": json.loads(document), "evidence": json.loads(evidence)}

    @staticmethod
    def advance_lanes(steps: Sequence[DayStep]) -> Iterator[tuple[DayState, EvaluationBlock] | Exception]:
        """Process blocks of several assets, each as `advance` does, to the last bit, or yield what went wrong.

        Regular blocks of one length, of monitors of one structure that are in one phase, go through the kernel side by
        side.
        """
        lanes: dict[Hashable, list[tuple[int, DayStep, _RowOrder]]] = defaultdict(list)
        advanced: dict[int, tuple[DayState, EvaluationBlock] | Exception] = {}
        for i, step in enumerate(steps):
            monitor, ordered = step.monitor, step.monitor._order(step.state, step.rows)
            key: Hashable = i
            if monitor._lane_key is not None and len(ordered[0]) and not ordered[1].any():
                phase = int(monitor.monitor.phase(step.state.monitor)[0])
                key = monitor._lane_key, phase, len(ordered[0])
            lanes[key].append((i, step, ordered))
        for together in lanes.values():
            try:
                followed = _follow([step for _, step, _ in together], [ordered for *_, ordered in together])
                for (i, step, ordered), (state, trace) in zip(together, followed, strict=True):
                    try:
                        advanced[i] = step.monitor._judge(step, ordered, state, trace)
                    except Exception as error:  # garbage of one asset must not cost another
                        advanced[i] = error
            except Exception as error:
                advanced |= {i: error for i, *_ in together}
        yield from (advanced[i] for i in range(len(steps)))


class DayStep(NamedTuple):
    """A block of an asset that is to be processed: the arguments of its monitor's `advance`."""

    monitor: DayMonitor
    state: DayState
    rows: Rows
    history: RowLookup


def _follow(steps: Sequence[DayStep], ordered: Sequence[_RowOrder]) -> list[tuple[FloatArray, Trace]]:
    """Return the state of the monitor and the evaluations of one block, or of several that go side by side."""
    states = [step.state.monitor for step in steps]
    if len(steps) == 1:
        ((rows, restart),) = ordered
        return [steps[0].monitor.monitor.run(states[0], rows.r, rows.u, rows.y, restart, channels=rows.channels)]
    distinct = list(dict.fromkeys(step.monitor for step in steps))
    fleet = _join_monitors(tuple(distinct)).select(np.array([distinct.index(step.monitor) for step in steps]))
    signals = (np.array([getattr(rows, name) for rows, _ in ordered]) for name in ("r", "u", "y"))
    monitors, trace = fleet.run(np.array(states), *signals)
    return [(monitors[lane].copy(), trace.lane(lane)) for lane in range(len(steps))]


@lru_cache(maxsize=256)
def _join_monitors(monitors: tuple[DayMonitor, ...]) -> Monitor:
    """Return the fleet of some monitors."""
    return Monitor.join([monitor.monitor for monitor in monitors])
