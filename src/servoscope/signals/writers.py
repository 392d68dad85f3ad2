"""Recordings to files, CSV or Parquet, with the columns that a loop reads back."""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.core.errors import OutputError
from servoscope.core.files import atomic_write
from servoscope.models.loop import Columns
from servoscope.signals import Recording
from servoscope.signals.readers.table import TIME_UNITS, is_number

SUFFIXES = (".csv", ".parquet", ".pq")


def plain_columns(covariates: Iterable[str]) -> Columns:
    """Return the columns of samples that a service kept: covariates stand under their own names."""
    return Columns(covariates={name: name for name in covariates})


def write_recording(path: str | Path, recording: Recording, columns: Columns | None = None) -> Columns:
    """Write t, r, u and y of a recording.

    `path`: a file that ends in .csv, .parquet or .pq; `columns`: names for the columns. What is no plain name, such
    as ``"0.025 * counts"``, becomes t, r, u or y; returns Columns: the mapping under which the file reads back; it
    differs from `columns` where a name was no plain one; raises OutputError if the suffix is another, or the file
    cannot be written.
    """
    wanted = columns or Columns()
    used = _simple_names(wanted)
    assigned: dict[str, npt.NDArray[Any]] = {
        used.time or "t": np.round(recording.t / TIME_UNITS[used.time_unit], 9),
        used.reference: recording.r,
        used.input: recording.u,
        **{
            name: recording.channels.get(sensor, recording.y)
            for name, sensor in zip(used.outputs, wanted.outputs, strict=True)
        },
        **{name: recording.run for name in used.segment},
        **{text: recording.channels[name] for name, text in used.covariates.items() if name in recording.channels},
    }
    write_table(path, assigned)
    return used


def write_table(path: str | Path, columns: Mapping[str, npt.NDArray[Any]]) -> None:
    """Write columns of equal length; nothing half-written stays behind.

    Raises OutputError if the suffix is none of `SUFFIXES`, or the file cannot be written.
    """
    import pyarrow as pa

    table = pa.table(dict(columns))
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise OutputError(f"{path}: cannot write this kind of file, end the name in {' or '.join(SUFFIXES)}")
    sink = io.BytesIO()
    if suffix == ".csv":
        import pyarrow.csv as csv

        cells = [f'"{name}"' if re.search(r'[,"\s]', name) else name for name in table.column_names]
        sink.write((",".join(cells) + "\n").encode())
        csv.write_csv(table, sink, csv.WriteOptions(include_header=False))
    else:
        import pyarrow.parquet as pq

        pq.write_table(table, sink)
    atomic_write(path, sink.getvalue())


def _simple_names(columns: Columns) -> Columns:
    texts = {"time": columns.time or "t", "reference": columns.reference, "input": columns.input}
    texts |= {f"output {i}": text for i, text in enumerate(columns.outputs)}
    letters = [*"tru", *(["y"] if len(columns.outputs) == 1 else [f"y{i + 1}" for i in range(len(columns.outputs))])]
    bare = {key: text.strip().strip("`").strip() for key, text in texts.items()}
    plain = {
        key: bare[key] if re.fullmatch(r"`[^`]+`|[^`*/+()\-\"]+", text.strip()) and not is_number(text) else letter
        for (key, text), letter in zip(texts.items(), letters, strict=True)
    }
    if len({*plain.values(), *columns.segment}) < len(plain) + len(columns.segment):
        plain = dict(zip(plain, letters, strict=True))
    changed: dict[str, Any] = {key: plain[key] for key in ("time", "reference", "input") if plain[key] != bare[key]}
    outputs = tuple(name for key, name in plain.items() if key.startswith("output "))
    if outputs != tuple(text for key, text in bare.items() if key.startswith("output ")):
        changed["output"] = outputs if len(outputs) > 1 else outputs[0]
    return columns.model_copy(update=changed)
