"""Some assets of a stream, a shard: their state in Spark, and what a worker does with their rows.

Rows of an asset may come in several Arrow batches, in any order, from any partition. They are only stored until the
watermark has passed them, and then followed in the order of time: where all rows are on time, results depend on them
alone. A row from before what has been followed already is late, and counted.

What reads and writes state costs the same for one asset as for many, so that assets share it.
"""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from servoscope.core.errors import BaselineError, ServoscopeError
from servoscope.fleet.baselines import Baselines
from servoscope.fleet.day_monitor import DayMonitor, DayState, DayStep, EvaluationBlock
from servoscope.fleet.partition import DAY_US, day_name
from servoscope.fleet.rows import Rows
from servoscope.fleet.stream_blocks import AssetRows, from_text, to_text
from servoscope.fleet.tasks import day_result, error_text, failed_result

SCHEMA = (
    "kind string, asset string, day string, time_us long, theta array<double>, statistic double, threshold double, "
    "level double, late long, result string"
)
CHUNK = 8_192  # rows of one entry of the state, about: larger ones cost the collector of the Java machine dearly
MAX_ROWS_HELD = 128 * CHUNK  # rows that a worker has in memory at a time, about, unless one asset has more
FAR_PAST = -(2**62)


@dataclass
class StreamState:
    """What is kept of an asset beside its raw rows: a line of numbers and the state of the day that is open."""

    baseline: str = ""  # its name
    processed_until_us: int = FAR_PAST  # all rows up to here have been followed [us]
    blocks: dict[int, tuple[int, int]] = field(default_factory=dict)  # entry -> first and last time [us] of its rows
    day: int | None = None  # the day that is open
    error: str = ""  # why the open day cannot be followed
    state: DayState | None = None

    def pack(self) -> bytes:
        """Return it as bytes."""
        numbers = {
            "by": self.baseline,
            "until_us": self.processed_until_us,
            "blocks": self.blocks,
            "day": self.day,
            "error": self.error,
        }
        return json.dumps(numbers).encode() + b"\n" + (self.state.pack() if self.state is not None else b"")

    @classmethod
    def unpack(cls, content: bytes) -> StreamState:
        """Return what `pack` packed."""
        line, _, packed = content.partition(b"\n")
        numbers = json.loads(line)
        blocks = {int(number): (low, high) for number, (low, high) in numbers["blocks"].items()}
        state = DayState.unpack(packed) if packed else None
        return cls(numbers["by"], numbers["until_us"], blocks, numbers["day"], numbers["error"], state)

    @property
    def due_us(self) -> int | None:
        """The time that the watermark has to pass before there is something to do [us]; None: nothing is."""
        done, over = self.processed_until_us, [] if self.day is None else [(self.day + 1) * DAY_US]
        waiting = (max(low, done + 1) for low, high in self.blocks.values() if high > done)  # rows, from there at most
        return min((*waiting, *over), default=None)


class StreamShard:
    """The assets of a shard, for as long as a worker processes them.

    `head`, `entries`, `handle`: Spark's value of all states, its map of raw rows, and what sets timers; `delay_us`: how
    far the watermark stays behind the latest row [us].
    """

    def __init__(self, head: Any, entries: Any, handle: Any, baselines: Baselines, delay_us: int) -> None:
        self._head, self._entries, self._handle, self._baselines = head, entries, handle, baselines
        self._delay_us = delay_us
        self._states: dict[str, StreamState] = {}
        self._next_entry = 0
        self._cache: dict[int, dict[str, Rows]] = {}
        packed = head.get()
        if packed is not None:
            line, _, content = from_text(packed[0]).partition(b"\n")
            numbers, end = json.loads(line), 0
            self._next_entry = numbers["next"]
            for asset, size in numbers["assets"]:
                self._states[asset] = StreamState.unpack(content[end : end + size])
                end += size

    def save(self) -> None:
        """Save the states, and set the timer: for the first row that waits, or the end of a day that is open."""
        times = [state.due_us for state in self._states.values()]
        due = min((time for time in times if time is not None), default=None)
        if due is not None:
            self._handle.registerTimer(due // 1000 + 1)
        packed = {asset: state.pack() for asset, state in self._states.items()}
        numbers = {"next": self._next_entry, "assets": [(asset, len(state)) for asset, state in packed.items()]}
        self._head.update((to_text(json.dumps(numbers).encode() + b"\n" + b"".join(packed.values())),))

    def store_rows(self, blocks: Iterable[AssetRows]) -> Iterator[Any]:
        """Store the rows that are on time; yield how many are late, by asset and day."""
        late: Counter[tuple[str, int]] = Counter()
        waiting: dict[str, list[Rows]] = defaultdict(list)
        held = 0
        for block in blocks:
            for asset, baseline, rows in block.split():
                state = self._states.setdefault(asset, StreamState())
                behind = rows.t_us <= state.processed_until_us
                if behind.any():
                    late.update((asset, day) for day in (rows.t_us[behind] // DAY_US).tolist())
                    rows = rows[~behind]
                if len(rows):
                    state.baseline = baseline
                    waiting[asset].append(rows)
                    held += len(rows)
            if held >= MAX_ROWS_HELD:
                self._add_entries(waiting)
                waiting.clear()
                held = 0
        self._add_entries(waiting)
        if late:
            assets, days = zip(*sorted(late), strict=True)
            counts = [late[key] for key in zip(assets, days, strict=True)]
            yield output(["late"] * len(late), asset=assets, day=list(map(day_name, days)), late=counts)

    def _add_entries(self, waiting: Mapping[str, list[Rows]]) -> None:
        """Store rows, those of an asset together, in entries of about `CHUNK` rows.

        What the next watermark will have passed is stored apart from what it will not: an entry of both is read twice.
        """
        ordered = {asset: Rows.concatenate(pieces).sort_by_time() for asset, pieces in waiting.items()}
        latest = max((int(rows.t_us[-1]) for rows in ordered.values()), default=FAR_PAST)
        for after, until in ((FAR_PAST, latest - self._delay_us), (latest - self._delay_us, latest)):
            parts: dict[str, Rows] = {}
            for asset, rows in ordered.items():
                low, high = np.searchsorted(rows.t_us, (after, until), side="right").tolist()
                if low < high:
                    parts[asset] = rows[low:high]
                if sum(map(len, parts.values())) >= CHUNK:
                    self._add_entry(parts)
                    parts = {}
            if parts:
                self._add_entry(parts)

    def _add_entry(self, parts: Mapping[str, Rows]) -> None:
        keys = [(asset, self._states[asset].baseline) for asset in parts]
        packed = AssetRows(keys, list(map(len, parts.values())), Rows.concatenate(list(parts.values()))).pack()
        self._entries.updateValue((self._next_entry,), (to_text(packed),))
        for asset, rows in parts.items():
            self._states[asset].blocks[self._next_entry] = (int(rows.t_us[0]), int(rows.t_us[-1]))
        self._next_entry += 1

    def process_until(self, until_us: int) -> Iterator[Any]:
        """Follow all rows up to a time, and close the days that are over by then; yield the results."""
        due = {asset: state.due_us for asset, state in self._states.items()}
        assets = [asset for asset, time in due.items() if time is not None and time <= until_us]
        # of assets whose rows are in the same entries
        assets.sort(key=lambda asset: (min(self._states[asset].blocks, default=-1), asset))
        before = {number for state in self._states.values() for number in state.blocks}
        while assets:
            pending: dict[str, Rows] = {}
            while assets and sum(map(len, pending.values())) < MAX_ROWS_HELD:
                state = self._states[asset := assets.pop(0)]
                pending[asset] = self._rows(asset, state.processed_until_us, until_us)
                state.processed_until_us = until_us
            yield from self._process(pending, until_us)
            self._cache.clear()
        for number in before - {number for state in self._states.values() for number in state.blocks}:
            self._entries.removeKey((number,))

    def _process(self, pending: Mapping[str, Rows], until_us: int) -> Iterator[Any]:
        """Follow rows of several assets, day by day, and close the days that are over."""
        days = {asset: np.unique(rows.t_us // DAY_US).tolist() for asset, rows in pending.items()}
        while any(days.values()):
            steps: dict[str, DayStep] = {}
            for asset in [asset for asset, left in days.items() if left]:
                state, rows, day = self._states[asset], pending[asset], days[asset].pop(0)
                if state.day is not None and state.day != day:
                    yield self._close_day(asset, state)
                state.day = day
                try:
                    monitor = self._day_monitor(state)
                except Exception as error:  # garbage of one asset must not end the stream
                    state.error = state.error or error_text(error)
                if not state.error:
                    of_day = (
                        rows if not days[asset] and rows.t_us[0] >= day * DAY_US else rows[rows.t_us // DAY_US == day]
                    )
                    begin = state.state if state.state is not None else monitor.start()
                    steps[asset] = DayStep(monitor, begin, of_day, partial(self._rows, asset))
            evaluations: dict[str, EvaluationBlock] = {}
            for asset, outcome in zip(steps, DayMonitor.advance_lanes(list(steps.values())), strict=True):
                if isinstance(outcome, Exception):
                    self._states[asset].error = error_text(outcome)
                    continue
                self._states[asset].state, evaluations[asset] = outcome
            if any(len(block.time_us) for block in evaluations.values()):
                yield self._trace_frame(evaluations)
        for asset in pending:
            state = self._states[asset]
            if state.day is not None and until_us >= (state.day + 1) * DAY_US:
                yield self._close_day(asset, state)
            keep = until_us
            if state.state is not None and not state.error:
                with suppress(BaselineError):  # a day that cannot go on needs no rows, and says so when it is over
                    keep = min(keep, self._day_monitor(state).needed_since(state.state))
            state.blocks = {number: ends for number, ends in state.blocks.items() if ends[1] > keep}

    def _day_monitor(self, state: StreamState) -> DayMonitor:
        """Return the monitor of a day; raises BaselineError if there is none, or the day began with another."""
        monitor = self._baselines.day_monitor(state.baseline)
        if state.state is not None and state.state.baseline != monitor.baseline.hash:
            raise BaselineError("its baseline changed during the day: the new one begins with the next day")
        return monitor

    def _trace_frame(self, evaluations: Mapping[str, EvaluationBlock]) -> Any:
        whole = EvaluationBlock.concatenate(evaluations.values())
        counts = [len(block.time_us) for block in evaluations.values()]
        days = [day_name(self._states[asset].day or 0) for asset in evaluations]
        assets = np.repeat(np.array(list(evaluations), dtype=object), counts)
        return output(
            ["trace"] * sum(counts),
            asset=assets,
            day=np.repeat(np.array(days, dtype=object), counts),
            **{**whole._asdict(), "theta": list(whole.theta)},
        )

    def _close_day(self, asset: str, state: StreamState) -> Any:
        assert state.day is not None, "a day is open"
        try:
            if state.error or state.state is None:
                raise ServoscopeError(state.error)
            monitor = self._day_monitor(state)
            result = day_result(monitor, monitor.finish(state.state, partial(self._rows, asset)))
        except Exception as error:
            result = failed_result(error)
        day = day_name(state.day)
        state.day, state.state, state.error = None, None, ""
        text = json.dumps({"asset": asset, "day": day, **result}, allow_nan=False)
        return output(["item"], asset=[asset], day=[day], result=[text])

    def _rows(self, asset: str, after_us: int, to_us: int) -> Rows:
        """Return the stored rows of an asset with after_us < t <= to_us, in the order of time."""
        parts = []
        for number, (low, high) in sorted(self._states[asset].blocks.items()):
            if high > after_us and low <= to_us:
                rows = self._entry(number)[asset]
                parts.append(rows if low > after_us and high <= to_us else rows.between(after_us, to_us))
        return Rows.concatenate(parts).sort_by_time()

    def _entry(self, number: int) -> Mapping[str, Rows]:
        if number not in self._cache:
            content = from_text(self._entries.getValue((number,))[0])
            self._cache[number] = {asset: rows for asset, _, rows in AssetRows.unpack(content).split()}
        return self._cache[number]


def output(kind: list[str], **columns: Any) -> Any:
    """Return rows of `SCHEMA`; columns that are not named are empty."""
    import pandas as pd

    known = {"kind": kind, **columns}
    names = [column.split()[0] for column in SCHEMA.split(", ")]
    return pd.DataFrame({name: known.get(name, [None] * len(kind)) for name in names})
