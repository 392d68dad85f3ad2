"""The states of assets that are followed together, as arrays: most blocks change nothing but a row of them.

Such a block is quiet: it follows the one before it, no examination or alarm comes from it, rows of the history and of
the coefficients only when they are due, and the state after it is a row of numbers. All that a quiet block does not
change stays in the record that the asset has.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray, IndexArray
from servoscope.service.assets.block_lanes import LanesOutput
from servoscope.service.assets.checkpoint import AssetState, StreamPosition, evolve
from servoscope.service.assets.examination_schedule import PendingDiagnosis
from servoscope.service.assets.records import TableRow
from servoscope.service.assets.residual_history import HistoryState
from servoscope.service.sources.block import covariate_tail
from servoscope.service.store.rows import SIZE_EVERY_S, coefficient_rows
from servoscope.signals import quality

COLUMNS = np.dtype(
    [
        ("is_here", np.bool_),  # whether the asset's state is this row
        # of its position
        ("t", np.float64),
        ("sequence", np.int64),
        ("stream", np.int64),
        ("blocks", np.int64),
        ("counted", np.int64),
        ("digest", np.int64),
        ("rows", np.int64),
        # of what was followed: times are NaN where there is none
        ("samples", np.int64),
        ("last_t", np.float64),
        ("evaluated", np.float64),
        ("exceeded", np.bool_),
        ("period", np.float64),
        ("excess", np.float64),
        ("level", np.float64),
        ("alarms_at", np.float64),
        ("lane", np.int64),
        # the rest that it is in
        ("is_fault", np.bool_),
        ("since", np.float64),
        ("until", np.float64),
    ]
)

# columns of the position, and its fields in their order
POSITION = ["t", "sequence", "blocks", "counted", "digest", "rows"]
POSITION_FIELDS = ["samples" if name == "counted" else name for name in POSITION]


class StateRow(NamedTuple):
    """Where the state of an asset is."""

    states: AssetStates
    row: int


class AssetStates:
    """A row for each of so many assets, whose monitors have states of `size` numbers; it may be empty."""

    def __init__(self, assets: int, size: int) -> None:
        self.columns = np.zeros(assets, COLUMNS)
        self.t = self.columns["t"]  # of the last sample of each [UTC s]
        self._positions = self.columns[POSITION]
        self.monitor, self.quality = np.zeros((assets, size)), np.zeros((assets, quality.init_state().size))
        # the newest evaluations of each asset, since its state is here; its column `lane` says which of them
        self._evaluations = np.full(assets, None, dtype=object)

    def put(self, row: int, state: AssetState, since: float, until: float) -> StateRow:
        """Write a state into a row.

        `since`, `until`: the asset is at rest between them while the recursion agrees with the verdict [UTC s].
        """
        position, history, evaluation = state.position, state.history, state.evaluation
        self.columns[row] = (
            True,
            *(position.t, position.sequence, position.stream, position.blocks, position.samples, position.digest),
            position.rows,
            *(state.samples, _number(state.last_t), _number(evaluation.t), evaluation.exceeded),
            *(_number(history.period), history.excess, history.level, _number(state.alarms_at)),
            *(0, state.examination.verdict == "fault", since, until),
        )
        self.monitor[row], self.quality[row], self._evaluations[row] = state.monitor, state.quality, None
        return StateRow(self, row)

    def leave(self, row: int) -> None:
        """Let a row be empty: an asset that falls silent must not hold the evaluations of all others."""
        self.columns["is_here"][row] = False
        self._evaluations[row] = None

    def read(self, row: int, before: AssetState) -> AssetState:
        """Return the state in a row; `before`: as it was put there."""
        position, evaluations = self.read_position(row, before.position), self._evaluations[row]
        if position is before.position:
            return before
        record = dict(zip(COLUMNS.names or (), self.columns[row].item(), strict=True))
        history, latest = before.history, before.evaluation
        if evaluations is not None:
            history = HistoryState(int(record["period"]), record["excess"], record["level"])
            latest = evaluations.latest(record["lane"])
        return evolve(
            before,
            monitor=self.monitor[row].copy(),
            quality=self.quality[row].copy(),
            position=position,
            history=history,
            evaluation=latest,
            **{key: record[key] for key in ("samples", "last_t", "alarms_at")},
        )

    def read_position(self, row: int, before: StreamPosition) -> StreamPosition:
        """Return the position of the state in a row; `before`: as it was put there."""
        values = self._positions[row].item()
        if values[POSITION.index("blocks")] == before.blocks:
            return before
        return evolve(before, **dict(zip(POSITION_FIELDS, values, strict=True)))

    def are_next(self, rows: IndexArray, sequences: Sequence[int], streams: Sequence[int]) -> BoolArray:
        """Tell which of some blocks follow what was counted."""
        columns = self.columns[rows]
        return np.asarray((columns["sequence"] + 1 == sequences) & (columns["stream"] == streams))

    def are_quiet(self, rows: IndexArray, output: LanesOutput) -> BoolArray:
        """Tell which blocks lead to nothing but the state after them; `output`: what they have led to so far."""
        columns, active = self.columns[rows], quality.ACTIVE
        quiet = (columns["since"] <= output.t) & (output.t < columns["until"])
        quiet &= (output.quality[:, active] == self.quality[rows, active]).all(axis=1)
        exceeded, new = columns["exceeded"], output.evaluations
        if new is not None:
            exceeded = new.exceeded
            quiet &= np.isfinite(columns["period"])
        return np.asarray(quiet & (exceeded == columns["is_fault"]))

    def advance(
        self, rows: IndexArray, output: LanesOutput, lanes: IndexArray, signals: FloatArray
    ) -> tuple[list[int], list[tuple[int, TableRow]]]:
        """Take what some `lanes` of quiet blocks have led to.

        `signals`: of all lanes, shape (blocks, 4 + k, N); the digest goes on as by what `Block.pack` returns. Returns
        the numbers of the blocks, and rows of the history and of the coefficients, each with the place of its lane.
        """
        columns, new = self.columns[rows], output.evaluations
        tail, numbers_of = covariate_tail(signals.shape[1] - 4), signals.astype("<f8", copy=False)
        digests = zip(lanes.tolist(), columns["digest"].tolist(), strict=True)
        numbers, history = columns["blocks"].tolist(), list[tuple[int, TableRow]]()
        columns["t"] = columns["last_t"] = columns["alarms_at"] = output.t[lanes]
        columns["digest"] = [zlib.crc32(tail, zlib.crc32(numbers_of[lane], before)) for lane, before in digests]
        for name, increment in (("sequence", 1), ("blocks", 1), ("counted", output.size), ("samples", output.size)):
            columns[name] += increment
        if new is not None:
            before = np.stack([columns["excess"], columns["level"]])
            (columns["excess"], columns["level"]), complete = new.update_histories(lanes, columns["period"], before)
            columns["period"] = new.periods[lanes, -1]
            for lane, row in complete:
                columns["rows"][lane] += 1
                history.append((lane, TableRow("residuals", {"number": columns["rows"][lane].item(), **row})))
            sized = new.t[lanes] // SIZE_EVERY_S != columns["evaluated"] // SIZE_EVERY_S  # as `period_number` says
            for lane in np.flatnonzero(sized).tolist():
                latest = new.latest(int(lanes[lane]))
                sizes = coefficient_rows(float(new.t[lanes[lane]]), latest.status.parameters)
                history += [(lane, TableRow("sizes", row)) for row in sizes]
            columns["exceeded"], columns["evaluated"], columns["lane"] = new.exceeded[lanes], new.t[lanes], lanes
            self._evaluations[rows] = new
        self.columns[rows], self.monitor[rows], self.quality[rows] = (
            columns,
            output.monitor[lanes],
            output.quality[lanes],
        )
        return numbers, history


class StateHolder:
    """Has the state of one asset: a record, or where this has gone on since."""

    def __init__(self) -> None:
        self._state: AssetState | None = None
        self._row: StateRow | None = None

    @property
    def state(self) -> AssetState | None:
        """All that decides what its next block leads to, as it is now; None before it has begun."""
        row, state = self._row, self._state
        return state if row is None or state is None else row.states.read(row.row, state)

    @state.setter
    def state(self, state: AssetState | None) -> None:
        self._state = state
        if self._row is not None:
            self._row.states.leave(self._row.row)
            self._row = None

    @property
    def visible_record(self) -> tuple[AssetState, StreamPosition] | None:
        """The record and the position, for another thread, while they may change; None before it has begun.

        Quality findings, examination and alarms are those of the record as long as the state is a row.
        """
        row, state = self._row, self._state  # each of them whole, if not the newest
        if state is None:
            return None
        return state, state.position if row is None else row.states.read_position(row.row, state.position)

    @property
    def has_state(self) -> bool:
        """Whether it has begun."""
        return self._state is not None

    @property
    def pending_diagnoses(self) -> tuple[PendingDiagnosis, ...]:
        """The full diagnoses that it waits for; quiet blocks ask for none, so that the record knows them."""
        return () if self._state is None else self._state.pending_diagnoses

    def renew_record(self) -> AssetState:
        """Return the state, and let the record be as it is now: what it had of earlier turns is let go."""
        self._state = state = self.state
        assert state is not None, "begin or resume comes first"
        return state

    def take_state(self) -> AssetState:
        """Return the state, and let it be nowhere else."""
        if self._row is not None:
            self.state = self.state
        assert self._state is not None, "begin or resume comes first"
        return self._state

    def count_rows(self, last: int) -> None:
        """Let further rows have numbers behind `last`, of one that is stored.

        Nearly always they have: not if a setting was changed after a kill, so that the samples in the store lead to
        fewer rows than they did, nor if a new state begins without them.
        """
        state = self.take_state()
        if last > state.position.rows:
            self.state = evolve(state, position=evolve(state.position, rows=last))

    @property
    def heard(self) -> bool:
        """Whether a block of it was ever counted."""
        return self._state is not None and self._state.position.blocks > 0

    @property
    def t(self) -> float:
        """Time of the last sample that was counted, or since when it waits for the first [UTC s]; NaN: it does not."""
        row, state = self._row, self._state
        return float(row.states.t[row.row]) if row is not None else math.nan if state is None else state.position.t


def _number(value: float | None) -> float:
    return math.nan if value is None else value
