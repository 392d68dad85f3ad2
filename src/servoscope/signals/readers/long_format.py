"""Tables of one value per row, as historians and InfluxDB export them: time, name and value become columns."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.core.errors import RecordingError
from servoscope.signals.readers.table import TableFile
from servoscope.signals.readers.units import with_unit

# Names of its columns, in small letters without blanks and underscores. Sources: InfluxData, "Annotated CSV"; Siemens,
# "WinCC: storing tags in data logs"; OSIsoft, "PI Builder and PI DataLink exports".
ROLES = {
    "time": ("time", "timestamp", "datetime", "timestring", "dateandtime", "ts", "t", "zeit", "zeitstempel", "date"),
    "name": (
        "field",
        "tagname",
        "tag",
        "varname",
        "variable",
        "signal",
        "channel",
        "metric",
        "name",
        "point",
        "sensor",
    ),
    "value": ("value", "varvalue", "val", "wert", "messwert"),
    "quality": ("quality", "validity", "status", "qualitat", "statuscode"),
    "unit": ("unit", "units", "einheit", "engunits", "uom"),
}
INFLUX_COLUMNS = ("result", "table", "start", "stop", "measurement")  # of InfluxDB, which tell no signals apart
DAY_COLUMN, DAY_UNIT_S = "timems", 0.0864  # of WinCC: millionths of a day since 1899
GOOD = re.compile(r"\s*(?:good|ok|valid|gut|true)", re.IGNORECASE)
GOOD_OPC = 192.0  # least quality code of OPC that is good
MIN_SHARE = 0.01  # of the rows of the most frequent signal: one with fewer is none, as lines between tables are
MIN_COMMON_SHARE = 0.9  # of the time stamps that signals have in common, if they were sampled together


def widen(opened: TableFile) -> TableFile:
    """Return a table with a column per signal; the table itself, where it has one already.

    Raises RecordingError if no value is left, or it has more than one machine's under one name.
    """
    plain = {re.sub(r"[\W_]|\(.*\)|\[.*\]", "", name).casefold(): name for name in opened.columns}
    roles = {role: plain[word] for role, words in ROLES.items() for word in reversed(words) if word in plain}
    if not {"time", "name", "value"} <= roles.keys():
        return opened
    if DAY_COLUMN in plain:
        roles["time"] = plain[DAY_COLUMN]
    known = (*roles.values(), *(plain[word] for word in ROLES["time"] if word in plain))
    labels = [name for word, name in plain.items() if name not in known and word not in INFLUX_COLUMNS]
    columns = _read_columns(opened, [*roles.values(), *labels])
    named = _text_codes(columns[roles["name"]])
    if named is None or 2 * len(named[1]) > len(named[0]):
        return opened
    codes, names = _label_signals(columns, labels, *named)
    values = _values(columns[roles["value"]])
    if "quality" in roles:
        values[~_good(columns[roles["quality"]])] = np.nan
    units = _text_codes(columns[roles["unit"]]) if "unit" in roles else None
    stamps, row = _stamps(columns[roles["time"]], DAY_COLUMN in plain)
    counts = np.bincount(codes, minlength=len(names))
    signals: dict[str, tuple[npt.NDArray[np.intp], FloatArray]] = {}
    for code in np.flatnonzero(counts > MIN_SHARE * counts.max()).tolist():
        mine = np.flatnonzero(codes == code)
        unit = units[1][units[0][mine[0]]] if units is not None else ""
        signals[with_unit(names[code], unit)] = row[mine], values[mine]
    time = "time [s]" if DAY_COLUMN in plain else roles["time"]

    def read_chunks(wanted: Sequence[str], _: Collection[str]) -> Iterator[Mapping[str, Any]]:
        import pyarrow as pa

        used = {name: signals[name] for name in wanted if name != time}
        rows = _common_rows(opened, used, len(stamps))
        cells: dict[str, Any] = {time: stamps.take(pa.array(rows))} if time in wanted else {}
        for name, (places, numbers) in used.items():
            full = np.full(len(stamps), np.nan)
            full[places] = numbers
            cells[name] = full[rows]
        yield cells

    return replace(opened, columns=(time, *signals), read_chunks=read_chunks, channel_groups=())


def _read_columns(opened: TableFile, names: Sequence[str]) -> dict[str, Any]:
    import pyarrow as pa

    pieces: dict[str, list[Any]] = {name: [] for name in names}
    for table in opened.iter_chunks(names):
        for name in names:
            pieces[name].append(table.columns[name])
    columns = {}
    for name, parts in pieces.items():
        if len({part.type for part in parts}) > 1:
            parts = [part.cast(pa.string()) for part in parts]
        columns[name] = pa.chunked_array([chunk for part in parts for chunk in part.chunks])
    return columns


def _text_codes(column: Any) -> tuple[npt.NDArray[np.intp], list[str]] | None:
    """Return a column of text as numbers, and the text of each; None where it is no text."""
    import pyarrow as pa

    kind = column.type
    if not (pa.types.is_string(kind) or pa.types.is_large_string(kind) or pa.types.is_dictionary(kind)):
        return None
    encoded = column.cast(pa.string()).fill_null("").combine_chunks().dictionary_encode()
    encoded = encoded.combine_chunks() if isinstance(encoded, pa.ChunkedArray) else encoded
    return np.asarray(encoded.indices).astype(np.intp), [str(text) for text in encoded.dictionary.to_pylist()]


def _label_signals(
    columns: Mapping[str, Any], labels: Sequence[str], codes: npt.NDArray[np.intp], names: list[str]
) -> tuple[npt.NDArray[np.intp], list[str]]:
    """Return the signals with those labels before their names that tell machines apart, such as tags of InfluxDB."""
    for label in labels:
        told = _text_codes(columns[label])
        if told is None or not 1 < len(told[1]) <= len(codes) // 2:
            continue
        joined = codes * len(told[1]) + told[0]
        kept, codes = np.unique(joined, return_inverse=True)
        names = [f"{told[1][pair % len(told[1])]}.{names[pair // len(told[1])]}" for pair in kept.tolist()]
    return codes, names


def _values(column: Any) -> FloatArray:
    """Return values as numbers, NaN where one is none: of a historian, others are states and texts."""
    import pyarrow as pa

    if pa.types.is_string(column.type) or pa.types.is_large_string(column.type):
        return np.array([_number(cell) for cell in column.to_pylist()])
    return np.array(
        column.cast(pa.float64(), safe=False).fill_null(np.nan).combine_chunks().to_numpy(zero_copy_only=False)
    )


def _number(cell: str | None) -> float:
    try:
        return float(cell or "nan")
    except ValueError:
        return float("nan")


def _good(column: Any) -> BoolArray:
    """Return where a quality is good: by its word, by OPC's code, or because most are so, shape (N,)."""
    told = _text_codes(column)
    if told is not None and any(map(GOOD.match, told[1])):
        return np.array([GOOD.match(text) is not None for text in told[1]])[told[0]]
    cells = told[0].astype(float) if told is not None else _values(column)
    if told is None and np.nanmax(cells, initial=0.0) >= GOOD_OPC:
        return np.asarray(cells >= GOOD_OPC)
    known, counts = np.unique(cells, return_counts=True)
    return np.asarray(cells == known[np.argmax(counts)])


def _stamps(column: Any, days: bool) -> tuple[Any, npt.NDArray[np.intp]]:
    """Return the different time stamps in their order, and that of each row."""
    import pyarrow as pa

    if days:
        column = pa.chunked_array([pa.array(_values(column) * DAY_UNIT_S)])
    encoded = column.combine_chunks().dictionary_encode()
    encoded = encoded.combine_chunks() if isinstance(encoded, pa.ChunkedArray) else encoded
    return encoded.dictionary, np.asarray(encoded.indices.fill_null(0)).astype(np.intp)


def _common_rows(
    opened: TableFile, used: Mapping[str, tuple[npt.NDArray[np.intp], FloatArray]], stamps: int
) -> npt.NDArray[np.intp]:
    """Return the time stamps at which signals have values; raises RecordingError if they have few in common."""
    counts = np.zeros((len(used), stamps), dtype=np.int64)
    for count, (name, (places, _)) in zip(counts, used.items(), strict=True):
        np.add.at(count, places, 1)
        if (count > 1).sum() > MIN_COMMON_SHARE * places.size / 2:
            raise RecordingError(f"{opened.path}: {name!r} has several values per time stamp, export one machine's")
    there = (counts > 0).sum(axis=0)
    rows = np.flatnonzero(there) if len(used) else np.arange(stamps)
    if len(used) > 1 and (there == len(used)).sum() < MIN_COMMON_SHARE * rows.size:
        raise RecordingError(
            f"{opened.path}: {', '.join(used)} have {(there == len(used)).mean():.0%} of their time stamps in common:"
            " export values interpolated to one rate"
        )
    return rows
