"""One asset's day, row by row: the pure step (state, block) -> (state, results) that every engine carries.

A day is followed by the compiled monitor, from fresh, in blocks of any length; around the first alarm, or at the end,
a window of raw rows is diagnosed. What comes out depends on the rows alone, not on how they were cut into blocks.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.baseline import Baseline
from servoscope.errors import ServoscopeError
from servoscope.fleet.evidence import evidence_of
from servoscope.fleet.rows import MICRO, Rows
from servoscope.monitor import Monitor, examine
from servoscope.plants import FloatArray
from servoscope.recording import clean
from servoscope.recording.clock import SAME

__all__ = ["WINDOW", "Evaluated", "Follower", "History", "Memory", "State"]

WINDOW = 120.0  # s of raw rows that a diagnosis sees, unless the user says otherwise
GAP = 1.5  # samples between two rows, from which on rows are missing

History = Callable[[int, int], Rows]  # rows of the day with after < t <= to, in order


@dataclass(frozen=True, eq=False)
class Evaluated:
    """What the monitor said, one row per evaluation: time [us], theta (K, n), T^2, its limit, level, over a limit."""

    t_us: npt.NDArray[np.int64]
    theta: FloatArray
    statistic: FloatArray
    threshold: FloatArray
    level: FloatArray
    exceeded: npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class State:
    """What is kept of a day between two blocks: plain numbers, the monitor's array, and the diagnosis once made.

    Parameters
    ----------
    monitor
        The monitor's own state.
    first_us, last_us
        First and last row so far [us].
    samples, repeats, missing, gaps
        Rows that the monitor took; rows that stood at the time of another; rows with an empty cell; holes.
    evaluations, exceeding
        Evaluations so far, and how many of the last ones in a row were over a limit.
    peak
        Largest statistic or level, as a multiple of its limit.
    alarm_us
        First alarm [us]; None: there was none.
    said
        What the diagnosis said; None until it is made.
    """

    monitor: FloatArray
    first_us: int | None = None
    last_us: int | None = None
    samples: int = 0
    repeats: int = 0
    missing: int = 0
    gaps: int = 0
    evaluations: int = 0
    exceeding: int = 0
    peak: float = 0.0
    alarm_us: int | None = None
    said: dict[str, Any] | None = None

    def pack(self) -> bytes:
        """Return it as bytes: numbers as one line of JSON, then the monitor's array."""
        numbers = {key: value for key, value in vars(self).items() if key != "monitor"}
        return json.dumps(numbers).encode() + b"\n" + np.ascontiguousarray(self.monitor).tobytes()

    @classmethod
    def unpack(cls, content: bytes) -> State:
        """Return what `pack` packed."""
        numbers, _, array = content.partition(b"\n")
        return cls(np.frombuffer(array, dtype=np.float64).copy(), **json.loads(numbers))


@dataclass
class Memory:
    """The last rows of a day, kept in memory: the history of engines that read a day in one go."""

    blocks: list[Rows] = field(default_factory=list)

    def add(self, rows: Rows) -> None:
        """Take in a block."""
        self.blocks.append(rows)

    def forget(self, until_us: int) -> None:
        """Drop blocks of which nothing is needed any more."""
        self.blocks = [block for block in self.blocks if len(block) and block.t_us[-1] > until_us]

    def __call__(self, after_us: int, to_us: int) -> Rows:
        """Return the rows with after_us < t <= to_us."""
        return Rows.joined([block.between(after_us, to_us) for block in self.blocks])


class Follower:
    """Follows days of assets of one baseline.

    Parameters
    ----------
    baseline
        What healthy looks like, with its share of the fleet's budget of false alarms.
    window_s
        Seconds of raw rows that a diagnosis sees; a shorter day is diagnosed whole.
    """

    def __init__(self, baseline: Baseline, window_s: float = WINDOW) -> None:
        self.baseline = baseline
        self.monitor = Monitor(baseline)
        self._window = round(window_s * MICRO)
        self._period = MICRO / baseline.loop.sample_rate
        self._on = self.monitor.pipeline.delays[0]

    def start(self) -> State:
        """Return the state before the first row of a day."""
        return State(self.monitor.init())

    def needed(self, state: State) -> int:
        """Return up to which time [us] rows are not needed any more."""
        last = state.last_us if state.last_us is not None else 0
        return last if state.said is not None else last - self._window

    def advance(self, state: State, rows: Rows, history: History) -> tuple[State, Evaluated]:
        """Take in a block: rows in order, behind all earlier ones.

        Parameters
        ----------
        state
            As returned by `start` or an earlier `advance`; it stays valid.
        rows
            The block.
        history
            Rows of this day, those of the block included, as far back as `needed` says.
        """
        if not len(rows):
            return state, self._nothing()
        last = state.last_us if state.last_us is not None else rows.t_us[0] - 10 * round(self._period)
        apart = np.diff(rows.t_us, prepend=last)
        repeated = apart < SAME * self._period
        apart, taken = apart[~repeated], rows[~repeated]
        restart = apart > GAP * self._period
        array, trace = self.monitor.run(state.monitor, taken.r, taken.u, taken.y, restart)
        index = np.round(trace.t * self.baseline.loop.sample_rate).astype(np.int64) - state.samples
        limits = np.full(len(trace.t), self.baseline.limit)
        exceeded = trace.exceeded
        found = Evaluated(taken.t_us[index], trace.theta, trace.statistic, limits, trace.level, exceeded)
        alarm, exceeding = self._alarm(state, found)
        empty = np.isnan(taken.r) | np.isnan(taken.u) | np.isnan(taken.y)
        high = np.maximum(found.statistic / limits, found.level)[trace.ready]
        state = replace(
            state,
            monitor=array,
            first_us=int(rows.t_us[0]) if state.first_us is None else state.first_us,
            last_us=int(rows.t_us[-1]),
            samples=state.samples + len(taken),
            repeats=state.repeats + int(repeated.sum()),
            missing=state.missing + int(empty.sum()),
            gaps=state.gaps + int(restart.sum()) - (state.first_us is None),
            evaluations=state.evaluations + len(found.t_us),
            exceeding=exceeding,
            peak=float(max(state.peak, high.max(initial=0.0))),
            alarm_us=alarm,
        )
        if state.said is None and alarm is not None and rows.t_us[-1] > (end := self._end(state, alarm)):
            state = replace(state, said=self._diagnosed(state, end, history))
        return state, found

    def finish(self, state: State, history: History) -> State:
        """Return the state at the end of the day, with its diagnosis.

        Raises
        ------
        RecordingError
            If there was no row.
        """
        if state.said is not None or state.last_us is None:
            return state
        return replace(state, said=self._diagnosed(state, state.last_us, history))

    def _alarm(self, state: State, found: Evaluated) -> tuple[int | None, int]:
        """Return the first alarm [us], and how many evaluations in a row are over a limit by now."""
        k = np.arange(len(found.exceeded))
        if not k.size:
            return state.alarm_us, state.exceeding
        calm = np.maximum.accumulate(np.where(found.exceeded, -1 - state.exceeding, k))
        raised = np.flatnonzero(k - calm > self._on)
        alarm = state.alarm_us
        if alarm is None and raised.size:
            alarm = int(found.t_us[raised[0]])
        return alarm, int(k[-1] - calm[-1])

    def _end(self, state: State, alarm_us: int) -> int:
        """Return where the window around an alarm ends: half of it is healthy past, as far as there is so much."""
        assert state.first_us is not None
        return max(alarm_us + self._window // 2, state.first_us + self._window)

    def _diagnosed(self, state: State, end_us: int, history: History) -> dict[str, Any]:
        """Diagnose the window that ends there; a day that cannot be diagnosed says why."""
        assert state.first_us is not None
        rows = history(max(end_us - self._window, state.first_us - 1), end_us)
        loop = self.baseline.loop
        try:
            t = (rows.t_us - state.first_us) / MICRO
            recording = clean(
                t, rows.r, rows.u, rows.y, name="window", sample_rate=loop.sample_rate, limits=loop.input_limits
            )
            diagnosis, trace = examine(self.baseline, recording)
        except ServoscopeError as error:
            return {"error": str(error).removeprefix("window: ")}
        evidence = json.dumps(asdict(evidence_of(self.baseline, trace)))
        said = diagnosis.model_dump_json(exclude={"recording"})
        return {"diagnosis": json.loads(said), "evidence": json.loads(evidence)}

    def _nothing(self) -> Evaluated:
        n = len(self.baseline.names)
        zero = np.zeros(0)
        return Evaluated(np.zeros(0, np.int64), np.zeros((0, n)), zero, zero, zero, np.zeros(0, np.bool_))
