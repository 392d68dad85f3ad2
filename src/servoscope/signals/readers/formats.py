"""Finds the reader of a file by its name, and checks that the file is what its name says."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path
from typing import NamedTuple

from servoscope.core.errors import RecordingError
from servoscope.signals.readers.csv import open_csv
from servoscope.signals.readers.mat import open_mat
from servoscope.signals.readers.mdf_tdms import open_mdf, open_tdms
from servoscope.signals.readers.parquet import open_parquet
from servoscope.signals.readers.table import TableFile

ENTRY_POINTS = "servoscope.readers"  # of other packages: name is the suffix without its dot, object the function


class Reader(NamedTuple):
    """A kind of file, and the function that opens one."""

    format: str
    open: Callable[[Path], TableFile]


CSV, PARQUET, MAT = Reader("CSV", open_csv), Reader("Parquet", open_parquet), Reader("MAT", open_mat)
MDF, TDMS = Reader("MDF", open_mdf), Reader("TDMS", open_tdms)
BUILT_IN = {
    **{".csv": CSV, ".txt": CSV, ".tsv": CSV, ".dat": CSV},
    **{".parquet": PARQUET, ".pq": PARQUET, ".mat": MAT, ".mf4": MDF, ".mdf": MDF, ".tdms": TDMS},
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


def readable_suffixes() -> list[str]:
    """Return the suffixes of the files that can be read, those of other packages last."""
    others = (f".{found.name.lower()}" for found in entry_points(group=ENTRY_POINTS))
    return list(dict.fromkeys([*BUILT_IN, *others]))


def open_file(path: str | Path) -> TableFile:
    """Open a file; its rows are not read yet.

    Raises RecordingError if the file cannot be read, is empty, or is not what its suffix says.
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
    suffix = path.suffix.lower()
    reader = BUILT_IN.get(suffix)
    if reader is not None:
        _check_format(path, head, reader.format)
    else:  # looked up only now: it takes a hundredth of a second
        other = next((found for found in entry_points(group=ENTRY_POINTS) if f".{found.name.lower()}" == suffix), None)
        if other is None:
            found = _recognise(head)
            what = f", it looks like a {found}" if found else ""
            known = ", ".join(readable_suffixes())
            raise RecordingError(f"{path}: unknown kind of file {path.suffix!r}{what}; readable are {known}")
        reader = Reader(other.name, other.load())
    opened = reader.open(path)
    if not opened.columns:
        raise RecordingError(f"{path}: holds no columns of numbers")
    return opened


def _recognise(head: bytes) -> str | None:
    """Return what a file is by its first bytes; None for text."""
    found = next((kind for magic, kind in MAGIC.items() if head.startswith(magic)), None)
    if found is None and head[:256].lstrip(b"\xef\xbb\xbf \r\n\t").lower().startswith(
        (b"<!doctype", b"<html", b"<?xml", b"<svg")
    ):
        return "HTML or XML page"
    if found is None and b"\0" in head and not head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "binary file"
    return found


def _check_format(path: Path, head: bytes, wanted: str) -> None:
    found = _recognise(head)
    if found == wanted or (wanted == "MAT" and found == "HDF5") or (wanted == "CSV" and found is None):
        return
    advice = {
        "Parquet": "rename it to .parquet",
        "MAT": "rename it to .mat",
        "MDF": "rename it to .mf4",
        "TDMS": "rename it to .tdms",
        "MDF file that its recorder never finished": "finalize it with the recorder's own tool",
    }.get(found or "", f"export it as {wanted}")
    raise RecordingError(f"{path}: is not {wanted} but a {found or 'text file'}: {advice}")
