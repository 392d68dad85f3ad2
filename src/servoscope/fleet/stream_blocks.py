"""Blocks of a stream: rows of several assets as bytes, which is what Spark moves, sorts and stores instead of rows."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING
from zlib import crc32

import numpy as np

from servoscope.core.arrays import IntArray
from servoscope.core.errors import RecordingError
from servoscope.fleet.rows import MICRO, Rows, covariates_from_table, signals_from_table, time_from_table
from servoscope.models.loop import Columns
from servoscope.signals.readers.table import Table, number_column

if TYPE_CHECKING:
    import pyarrow as pa

BLOCKS = "shard int, last_us long, rows binary"  # rows of the assets of a shard, packed; until when they are
KEYS = ("asset", "baseline_of")
ONES = np.uint64(0x0101010101010101)
SAMPLE_TIME = "dt"  # [s], the column of messages whose time is that of their first sample
MAX_MESSAGE_S = 86_400.0  # s of a message; what claims more would set the clock of the whole stream


@dataclass(frozen=True, eq=False)
class AssetRows:
    """Rows of several assets, one asset after the other."""

    keys: Sequence[tuple[str, str]]  # asset and name of its baseline
    counts: Sequence[int]  # rows of each
    rows: Rows

    def split(self) -> Iterator[tuple[str, str, Rows]]:
        """Yield each asset, the name of its baseline, and its rows."""
        end = 0
        for (asset, baseline), count in zip(self.keys, self.counts, strict=True):
            end += count
            yield asset, baseline, self.rows[end - count : end]

    def pack(self) -> bytes:
        """Return them as bytes: a line of JSON, filled up to whole numbers of 8 bytes, and the packed rows."""
        line = json.dumps([list(self.keys), list(self.counts)]).encode()
        return self.rows.pack(line + b" " * (-(len(line) + 1) % 8) + b"\n")

    @classmethod
    def unpack(cls, content: bytes) -> AssetRows:
        """Return what `pack` packed; the rows are views of it."""
        end = content.index(b"\n") + 1
        keys, counts = json.loads(content[:end])
        return cls([(asset, baseline) for asset, baseline in keys], counts, Rows.unpack(content, end))


def pack_blocks(
    batches: Iterable[pa.RecordBatch], time: str, columns: Columns, shards: int
) -> Iterator[pa.RecordBatch]:
    """Yield what Arrow batches hold as blocks of `BLOCKS`, one per batch and shard.

    `batches`: with `KEYS`, the column `time` and signals; a cell is the number of one sample, or the list of those of a
    message; `shards`: among how many the assets are shared out.
    """
    import pyarrow as pa

    for batch in batches:
        if not batch.num_rows:
            continue
        assets, baselines = (batch[key].dictionary_encode(null_encoding="encode") for key in KEYS)
        names, by = assets.dictionary.to_pylist(), baselines.dictionary.to_pylist()
        own = np.array([crc32(name.encode()) % shards for name in names])[np.asarray(assets.indices)]
        code = (own * len(names) + np.asarray(assets.indices)) * len(by) + np.asarray(baselines.indices)
        if (np.diff(code) < 0).any():
            order = np.argsort(code, kind="stable")
            batch, code = batch.take(pa.array(order)), code[order]
        counts, rows = _flatten(batch, time, columns)
        first = np.flatnonzero(np.diff(code, prepend=-1))
        key, count = code[first], np.add.reduceat(counts, first)
        begin = np.flatnonzero(np.diff(key // (len(names) * len(by)), prepend=-1))  # of each shard, among the keys
        ends = np.cumsum(count)
        parts = [
            AssetRows(
                [(names[k // len(by) % len(names)], by[k % len(by)]) for k in key[low:high].tolist()],
                count[low:high].tolist(),
                rows[ends[low] - count[low] : ends[high - 1]],
            )
            for low, high in zip(begin.tolist(), [*begin[1:].tolist(), len(key)], strict=True)
        ]
        shard = (key[begin] // (len(names) * len(by))).tolist()
        some = [(number, part) for number, part in zip(shard, parts, strict=True) if len(part.rows)]
        yield pa.RecordBatch.from_arrays(
            [
                pa.array([number for number, _ in some], pa.int32()),
                pa.array([int(part.rows.t_us.max()) for _, part in some], pa.int64()),
                pa.array([part.pack() for _, part in some], pa.binary()),
            ],
            names=["shard", "last_us", "rows"],
        )


def _flatten(batch: pa.RecordBatch, time: str, columns: Columns) -> tuple[IntArray, Rows]:
    """Return how many rows with a time each line of a batch has, shape (lines,), and all of these rows."""
    import pyarrow as pa

    names = [name for name in batch.schema.names if name not in KEYS]
    lists = [name for name in names if pa.types.is_list(batch.schema.field(name).type)]
    lengths = {name: np.asarray(batch[name].value_lengths().fill_null(0)).astype(np.int64) for name in lists}
    counts = np.ones(batch.num_rows, dtype=np.int64)
    if lists:
        counts = lengths[time] if time in lengths else np.max(list(lengths.values()), axis=0)
    flat = {name: _column(batch[name], counts, lengths.get(name)) for name in names}
    table = Table("the stream", {name: pa.chunked_array([column]) for name, column in flat.items()})
    t_us, known = time_from_table(table, columns)
    if lists and time not in lists:
        number = np.arange(len(t_us)) - np.repeat(np.cumsum(counts) - counts, counts)
        step = number_column(table, SAMPLE_TIME, "sample time")
        known &= np.abs(step) * np.repeat(counts, counts) < MAX_MESSAGE_S  # not so where there is none
        t_us = t_us + np.rint(number * np.where(known, step, 0.0) * MICRO).astype(np.int64)
    rows = Rows(t_us, *signals_from_table(table, columns), covariates_from_table(table, columns))
    if known.all():
        return counts, rows
    lines = np.repeat(np.arange(len(counts)), counts)
    return np.bincount(lines[known], minlength=len(counts)), rows[known]


def _column(column: pa.Array, counts: IntArray, lengths: IntArray | None) -> pa.Array:
    """Return a column with one value per sample: lists one after the other, single values as often as needed.

    Of a list that is not as long as its block nobody can tell which samples it belongs to: all of it is missing.
    """
    import pyarrow as pa

    if lengths is None:
        return column if (counts == 1).all() else column.take(pa.array(np.repeat(np.arange(len(counts)), counts)))
    good = lengths == counts
    if good.all():
        return column.flatten()
    here = np.repeat(good, counts)
    return column.filter(pa.array(good)).flatten().take(pa.array(np.cumsum(here) - 1, mask=~here))


def to_text(content: bytes) -> str:
    """Return bytes as text of 7 bits, which Spark hands to Python's state and back far faster than bytes.

    Seven words of 8 bytes become eight: the last one takes the highest bit of every byte of the others.
    """
    words = np.frombuffer(content + bytes(-len(content) % 56), dtype=np.uint64).reshape(7, -1)
    text = np.empty((8, words.shape[1]), dtype=np.uint64)
    np.bitwise_and(words, 0x7F * ONES, out=text[:7])
    text[7] = 0
    for i, word in enumerate(words):
        text[7] |= ((word >> 7) & ONES) << i
    return text.tobytes().decode("ascii") + str(len(content))


def from_text(text: str) -> bytes:
    """Return what `to_text` took."""
    content = text.encode("ascii")
    used = len(content) // 64 * 64
    *words, highest = np.frombuffer(content, dtype=np.uint64, count=used // 8).reshape(8, -1)
    decoded = np.array([word | (((highest >> i) & ONES) << 7) for i, word in enumerate(words)])
    return decoded.tobytes()[: int(content[used:])]


def check_lists(lists: Sequence[str], names: Sequence[str], time: str) -> None:
    """Check that a stream's columns are those of rows or those of messages; `lists`: which of `names` are arrays.

    Raises RecordingError if they are neither.
    """
    if not lists:
        return
    single = [name for name in names if name not in lists and name != SAMPLE_TIME]
    if single and single != [time]:
        raise RecordingError(f"the stream: column {single[-1]!r} holds single numbers, and {lists[0]!r} arrays of them")
    if single and SAMPLE_TIME not in names:
        raise RecordingError(
            f"the stream: column {time!r} holds the time of a block's first sample: the column "
            f"{SAMPLE_TIME!r} must say how many seconds are between two, or {time!r} hold an array"
        )
