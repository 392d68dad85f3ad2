"""Opens files of any kind that is understood and returns their columns, not yet telling r from u."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.errors import RecordingError
from servoscope.readers import csvtext

__all__ = ["SUFFIXES", "Table", "number_column", "open_table", "seconds"]

FloatArray = npt.NDArray[np.float64]

SUFFIXES = {
    ".csv": "CSV",
    ".txt": "CSV",
    ".tsv": "CSV",
    ".dat": "CSV",
    ".parquet": "Parquet",
    ".pq": "Parquet",
    ".mat": "MAT",
}
MAGIC = {
    b"PAR1": "Parquet",
    b"MATLAB 5.0": "MAT",
    b"MATLAB 7.3": "MAT",
    b"\x89HDF\r\n": "HDF5",
    b"\x89PNG": "PNG image",
    b"\xff\xd8\xff": "JPEG image",
    b"GIF8": "GIF image",
    b"%PDF": "PDF",
    b"PK\x03\x04": "ZIP archive or Excel workbook",
    b"\xd0\xcf\x11\xe0": "Excel workbook",
    b"\x1f\x8b": "gzip archive",
    b"MDF ": "MDF",
    b"TDSm": "TDMS",
}
UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0}


@dataclass(frozen=True, eq=False)
class Table:
    """Columns of a file.

    Parameters
    ----------
    name
        What errors call the file.
    columns
        Name -> Arrow column; all of equal length.
    first_row
        Number of the first row in the file, as an editor counts.
    broken
        Rows that could not be split into the columns: (rows read before it, number in the file, text).
    others
        Variables that exist but are not channels: name -> why not.
    """

    name: str
    columns: dict[str, Any]
    first_row: int = 1
    broken: tuple[tuple[int, int, str], ...] = ()
    others: dict[str, str] = field(default_factory=dict)

    @property
    def rows(self) -> int:
        """Number of rows."""
        return len(next(iter(self.columns.values()), ()))

    def row_number(self, index: int) -> int:
        """Return where row `index` stands in the file, broken rows before it counted."""
        return self.first_row + index + sum(before <= index for before, _, _ in self.broken)


def open_table(path: str | Path) -> Table:
    """Read all columns of a file.

    Raises
    ------
    RecordingError
        If the file cannot be read, is empty, or is not what its suffix says.
    """
    path = Path(path)
    if path.is_dir():
        raise RecordingError(f"{path}: is a directory, give a recording in it")
    try:
        with path.open("rb") as file:
            head = file.read(65536)
    except FileNotFoundError:
        raise RecordingError(f"{path}: no such file, check the path of the recording") from None
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror or error})") from None
    if not head.strip():
        raise RecordingError(f"{path}: is empty")
    kind = _check_kind(path, head)
    if kind == "Parquet":
        table = _parquet(path)
    elif kind == "MAT":
        table = _mat(path)
    else:
        read = csvtext.read_csv(path, head)
        table = Table(path.name, read.columns, read.first_row, tuple(read.broken))
    if not table.columns:
        raise RecordingError(f"{path}: holds no columns of numbers")
    if table.rows == 0:
        raise RecordingError(f"{path}: holds no rows")
    return table


def number_column(table: Table, name: str, what: str) -> FloatArray:
    """Return a column as numbers, shape (N,), NaN where a cell is empty.

    Parameters
    ----------
    what
        What the column is wanted for, for messages.

    Raises
    ------
    RecordingError
        If a cell holds text; it names row, column and text.
    """
    import pyarrow as pa
    import pyarrow.compute as pc

    column = table.columns[name]
    kind = column.type
    if pa.types.is_dictionary(kind):
        column, kind = column.cast(kind.value_type), kind.value_type
    if pa.types.is_string(kind) or pa.types.is_large_string(kind):
        return _from_text(table, name, column.to_pylist())
    if pa.types.is_temporal(kind):
        raise RecordingError(f"{table.name}: {what}: column {name!r} holds times, not numbers, choose another column")
    try:
        if pa.types.is_boolean(kind):
            column = column.cast(pa.int8())
        numbers = pc.cast(column, pa.float64(), safe=False)
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError):
        raise RecordingError(f"{table.name}: {what}: column {name!r} holds {kind}, not numbers") from None
    # neither to_numpy nor a needless fill: both import pandas where they find it, a fifth of a second
    chunks = (pc.fill_null(numbers, np.nan) if numbers.null_count else numbers).chunks
    return np.concatenate([np.zeros(0), *(np.from_dlpack(chunk) for chunk in chunks if len(chunk))])


def seconds(table: Table, name: str, unit: str) -> FloatArray:
    """Return the time column in seconds, shape (N,); date and time count from the first row.

    Raises
    ------
    RecordingError
        If a cell holds text that is neither number nor time.
    """
    import pyarrow as pa
    import pyarrow.compute as pc

    column = table.columns[name]
    if not pa.types.is_temporal(column.type):
        return number_column(table, name, "time") * UNITS[unit]
    missing = np.asarray(column.is_null().to_numpy(zero_copy_only=False), dtype=bool)
    if pa.types.is_date(column.type):
        column = pc.cast(column, pa.timestamp("ms"))
    elif pa.types.is_time32(column.type):
        column = pc.cast(column, pa.time64("ns"))
    per_second = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}[column.type.unit]
    whole = column.cast(pa.int64()).fill_null(0).to_numpy()
    known = np.flatnonzero(~missing)
    # Whole numbers are subtracted first: nanoseconds since 1970 do not fit into a float.
    since = (whole - (whole[known[0]] if known.size else 0)) / per_second
    return np.where(missing, np.nan, since)


def _from_text(table: Table, name: str, cells: list[str | None]) -> FloatArray:
    numbers = np.empty(len(cells))
    for index, cell in enumerate(cells):
        text = "" if cell is None else cell.strip()
        try:
            numbers[index] = np.nan if text in csvtext.NULLS else float(text.replace("_", "x"))
        except ValueError:
            shown = text if len(text) <= 40 else f"{text[:37]}..."
            raise RecordingError(
                f"{table.name}: row {table.row_number(index)}, column {name!r}: {shown!r} is not a number,"
                " correct it or leave the cell empty"
            ) from None
    return numbers


def _check_kind(path: Path, head: bytes) -> str:
    wanted = SUFFIXES.get(path.suffix.lower())
    found = next((kind for magic, kind in MAGIC.items() if head.startswith(magic)), None)
    if found is None and head[:256].lstrip(b"\xef\xbb\xbf \r\n\t").lower().startswith(
        (b"<!doctype", b"<html", b"<?xml", b"<svg")
    ):
        found = "HTML or XML page"
    if found is None and b"\0" in head and not head.startswith((b"\xff\xfe", b"\xfe\xff")):
        found = "binary file"
    if wanted is None:
        known = ", ".join(SUFFIXES)
        what = f", it looks like a {found}" if found else ""
        raise RecordingError(f"{path}: unknown kind of file {path.suffix!r}{what}; readable are {known}")
    is_mat = wanted == "MAT" and found in ("MAT", "HDF5")
    if is_mat or found == wanted or (wanted == "CSV" and found is None):
        return wanted
    advice = {"Parquet": "rename it to .parquet", "MAT": "rename it to .mat"}.get(found or "", f"export it as {wanted}")
    raise RecordingError(f"{path}: is not {wanted} but a {found or 'text file'}: {advice}")


def _parquet(path: Path) -> Table:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(path, partitioning=None)
    except (pa.ArrowException, OSError) as error:
        raise RecordingError(f"{path}: is a damaged Parquet file ({_short(error)}), write it again") from None
    names = [name for name in table.column_names if table.column_names.count(name) == 1]
    return Table(path.name, {name: table.column(name) for name in names})


def _mat(path: Path) -> Table:
    import pyarrow as pa

    try:
        variables = dict(_flat(_load_mat(path)))
    # SciPy and h5py raise nearly anything at damaged files, from MatReadError to AttributeError.
    except Exception as error:
        raise RecordingError(f"{path}: is a damaged or unknown MAT file ({_short(error)}), save it again") from None
    lengths = [x.size for x in variables.values() if x.size > 1]
    # The channels are the vectors of the length that most of them, and of those the longest, have.
    rows = max(lengths, key=lambda size: (lengths.count(size), size), default=0)
    columns = {name: pa.chunked_array([x]) for name, x in variables.items() if x.size == rows}
    others = {name: f"has {x.size} values, the channels have {rows}" for name, x in variables.items() if x.size != rows}
    return Table(path.name, columns, others=others)


def _load_mat(path: Path) -> Mapping[str, Any]:
    import h5py
    import scipy.io

    if not h5py.is_hdf5(path):
        loaded: dict[str, Any] = scipy.io.loadmat(path, squeeze_me=False)
        return {name: value for name, value in loaded.items() if not name.startswith("__")}

    def group(node: Any) -> dict[str, Any]:
        inner: dict[str, Any] = {}
        for name, item in node.items():
            if isinstance(item, h5py.Group):
                if not name.startswith("#"):
                    inner[name] = group(item)
            elif item.attrs.get("MATLAB_class", b"double") not in (b"char", b"cell"):
                inner[name] = np.asarray(item[()]).T  # MATLAB counts columns first
        return inner

    with h5py.File(path, "r") as file:
        return group(file)


def _flat(variables: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, npt.NDArray[Any]]]:
    """Walk variables and structs, ``motor.speed``; the columns of a matrix become ``x[0]``, ``x[1]``."""
    for key, value in variables.items():
        name = f"{prefix}{key}"
        array = value if isinstance(value, Mapping) else np.asarray(value)
        if isinstance(array, Mapping):
            yield from _flat(array, f"{name}.")
        elif array.dtype.names and array.size == 1:
            yield from _flat({part: array[part].item() for part in array.dtype.names}, f"{name}.")
        elif array.dtype.kind in "fiub" and array.ndim <= 2:
            plain = array.astype(array.dtype.newbyteorder("="))
            if plain.ndim < 2 or 1 in plain.shape:
                yield name, np.ascontiguousarray(plain.reshape(-1))
            else:
                for index in range(plain.shape[1]):
                    yield f"{name}[{index}]", np.ascontiguousarray(plain[:, index])


def _short(error: Exception) -> str:
    text = " ".join(str(error).split())
    return text if len(text) <= 80 else f"{text[:77]}..."
