"""Opens files of any kind that is understood, and reads their columns piece by piece, not yet telling r from u."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.errors import RecordingError
from servoscope.readers import csvtext, mat5, measurements
from servoscope.readers.opened import Opened
from servoscope.readers.tables import Table

__all__ = ["SUFFIXES", "Opened", "open_file"]

ROWS = 1 << 16  # of a Parquet file that are read at a time
BUFFER = 1 << 20  # bytes of each of its columns

SUFFIXES = {
    ".csv": "CSV",
    ".txt": "CSV",
    ".tsv": "CSV",
    ".dat": "CSV",
    ".parquet": "Parquet",
    ".pq": "Parquet",
    ".mat": "MAT",
    ".mf4": "MDF",
    ".mdf": "MDF",
    ".tdms": "TDMS",
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
    b"UnFinMF ": "MDF file that its recorder never finished",
    b"TDSm": "TDMS",
}


def open_file(path: str | Path) -> Opened:
    """Look at a file.

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
        return _parquet(path)
    if kind == "MAT":
        return _mat(path)
    if kind in ("MDF", "TDMS"):
        return measurements.mdf(path) if kind == "MDF" else measurements.tdms(path)
    layout = csvtext.layout_of(path, head)
    return Opened(path, tuple(layout.names), lambda *wanted: csvtext.read_csv(path, layout, *wanted))


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
    advice = {
        "Parquet": "rename it to .parquet",
        "MAT": "rename it to .mat",
        "MDF": "rename it to .mf4",
        "TDMS": "rename it to .tdms",
        "MDF file that its recorder never finished": "finalize it with the recorder's own tool",
    }.get(found or "", f"export it as {wanted}")
    raise RecordingError(f"{path}: is not {wanted} but a {found or 'text file'}: {advice}")


def _parquet(path: Path) -> Opened:
    import pyarrow as pa
    import pyarrow.parquet as pq

    def damaged(error: Exception) -> RecordingError:
        return RecordingError(f"{path}: is a damaged Parquet file ({_short(error)}), write it again")

    def read(wanted: Sequence[str], _: Collection[str]) -> Iterator[Table]:
        first = 1
        try:
            # neither read_table nor a memory map: the one imports pandas, the other takes the file for memory
            with pq.ParquetFile(path, buffer_size=BUFFER, pre_buffer=False) as file:
                for batch in file.iter_batches(ROWS, columns=list(wanted)):
                    columns = {name: pa.chunked_array([batch.column(name)]) for name in wanted}
                    yield Table(path.name, columns, first)
                    first += batch.num_rows
        except (pa.ArrowException, OSError) as error:
            raise damaged(error) from None

    try:
        with pq.ParquetFile(path) as file:
            names = file.schema_arrow.names
    except (pa.ArrowException, OSError) as error:
        raise damaged(error) from None
    return Opened(path, _some(path, [name for name in names if names.count(name) == 1]), read)


def _some(path: Path, names: Sequence[str]) -> tuple[str, ...]:
    if not names:
        raise RecordingError(f"{path}: holds no columns of numbers")
    return tuple(names)


def _mat(path: Path) -> Opened:
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
    return Opened(path, _some(path, list(columns)), lambda *_: iter([Table(path.name, columns)]), others)


def _load_mat(path: Path) -> Mapping[str, Any]:
    import h5py
    import scipy.io

    if not h5py.is_hdf5(path):
        mat5.check(path)
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
