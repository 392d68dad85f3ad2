"""Frames and arrays in the place of files: the same columns, and the same rules for dirty rows."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from servoscope.core.errors import RecordingError
from servoscope.models.loop import TextLayout
from servoscope.signals.readers.formats import open_file
from servoscope.signals.readers.table import TableFile, one_line_errors

if TYPE_CHECKING:
    from typing_extensions import TypeIs


class ArrowStream(Protocol):
    """A frame that hands its columns over by Arrow's protocol, as those of pandas and polars do."""

    def __arrow_c_stream__(self, requested_schema: Any = None) -> Any:
        """Return a capsule of Arrow."""


class LazyFrame(Protocol):
    """A frame that is computed when its rows are asked for, as polars has it."""

    def collect(self) -> ArrowStream:
        """Return the frame itself."""


Frame = ArrowStream | LazyFrame
Source = str | Path | Mapping[str, npt.ArrayLike] | Frame


def is_frame(source: object) -> TypeIs[Frame]:
    """Tell whether something is a frame, and no path, mapping or list of them."""
    return hasattr(source, "__arrow_c_stream__") or callable(getattr(source, "collect", None))


def is_columns(source: object) -> TypeIs[Mapping[str, npt.ArrayLike]]:
    """Tell whether something is arrays by name, and not recordings by the name of their operating point."""
    if not isinstance(source, Mapping) or not source:
        return False
    firsts = (values[0] if isinstance(values, list | tuple) and values else values for values in source.values())
    return all((np.isscalar(x) and not isinstance(x, str)) or isinstance(x, np.ndarray) for x in firsts)


def open_source(source: Source, text: TextLayout | None = None) -> TableFile:
    """Open a file, a frame, or a mapping of names to arrays.

    Raises TypeError if it is none of these, RecordingError if it cannot be read.
    """
    if isinstance(source, str | Path):
        return open_file(source, text)
    return _open_table("arrays" if isinstance(source, Mapping) else "frame", _arrow_table(source))


def write_source(source: Mapping[str, npt.ArrayLike] | Frame, folder: Path) -> Path:
    """Write a frame, or a mapping of names to arrays, as a file; raises as `open_source` does."""
    import pyarrow.parquet as pq

    path = folder / ("arrays.parquet" if isinstance(source, Mapping) else "frame.parquet")
    pq.write_table(_arrow_table(source), path)
    return path


def _arrow_table(source: Mapping[str, npt.ArrayLike] | Frame) -> Any:
    import pyarrow as pa

    if isinstance(source, Mapping):
        columns = {str(name): np.asarray(values) for name, values in source.items()}
        odd = next((name for name, x in columns.items() if x.ndim != 1), None)
        if odd is not None:
            raise RecordingError(f"arrays: {odd!r} has {columns[odd].ndim} dimensions, give columns of one")
        lengths = {name: x.size for name, x in columns.items()}
        if len(set(lengths.values())) > 1:
            told = ", ".join(f"{name} {length}" for name, length in lengths.items())
            raise RecordingError(f"arrays: their lengths differ ({told}), give columns of one length")
        return pa.table(columns)
    if not is_frame(source):
        kind = type(source).__name__
        raise TypeError(f"a recording is read from a path, a frame or a mapping of arrays, not from {kind}")
    with one_line_errors("frame", "cannot be read", "give plain columns", (pa.ArrowException, TypeError, ValueError)):
        return pa.table(source if hasattr(source, "__arrow_c_stream__") else source.collect())


def _open_table(name: str, table: Any) -> TableFile:
    return TableFile.from_columns(Path(name), {column: table.column(column) for column in table.column_names})
