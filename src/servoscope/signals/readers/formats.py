"""Finds the reader of a file by its name, and checks that the file is what its name says."""

from __future__ import annotations

import importlib
import stat
from collections.abc import Callable
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from servoscope.core.errors import EmptyRecordingError, RecordingError
from servoscope.models.loop import TextLayout
from servoscope.signals.readers.addresses import open_address
from servoscope.signals.readers.archives import ARCHIVES, archive_of, unpack
from servoscope.signals.readers.csv import is_utf16
from servoscope.signals.readers.long_format import widen
from servoscope.signals.readers.reader_process import is_inside, open_bounded
from servoscope.signals.readers.table import TableFile

ENTRY_POINTS = "servoscope.readers"  # of other packages: name is the suffix without its dot, object the function


class Reader(NamedTuple):
    """A kind of file, and the function that opens one.

    `module`, `function`: where that function is; `library`: what it imports beyond what servoscope needs; `extra`: with
    what it is installed; `bounded`: whether a damaged file may hang or kill the process that reads it.
    """

    format: str
    module: str
    function: str
    library: str = ""
    extra: str = ""
    bounded: bool = False

    @property
    def installed(self) -> bool:
        """Whether its library is there."""
        return not self.library or find_spec(self.library) is not None

    def open(self, path: Path, text: TextLayout | None) -> TableFile:
        """Open a file; raises RecordingError if the library is missing or the file is damaged."""
        if not self.installed:
            raise RecordingError(
                f"{path}: {self.format} files need {self.library}, pip install 'servoscope[{self.extra}]'"
            )
        layout = (text,) if self.format == "CSV" else ()
        if self.bounded and not is_inside():
            return open_bounded(path, self.format, self.module, self.function, self.library or self.module, *layout)
        opened: TableFile = getattr(importlib.import_module(self.module), self.function)(path, *layout)
        return opened


_PACKAGE = "servoscope.signals.readers"
BUILT_IN = {
    suffix: Reader(format_, f"{_PACKAGE}.{module}", *arguments)
    for suffixes, format_, module, *arguments in (
        (".csv .txt .tsv .dat .asc .log", "CSV", "csv", "open_csv"),
        (".parquet .pq", "Parquet", "parquet", "open_parquet"),
        (".mat", "MAT", "mat", "open_mat", "", "", True),  # SciPy trusts its types: a wrong one kills
        (".mf4 .mdf", "MDF", "mdf_tdms", "open_mdf", "asammdf", "mdf", True),
        (".tdms", "TDMS", "mdf_tdms", "open_tdms", "nptdms", "tdms", True),
        (".h5 .hdf5", "HDF5", "mat", "open_hdf5", "", "", True),
        (".xlsx .xls .ods", "Excel", "programs", "open_sheet", "python_calamine", "formats", True),
        (".lvm", "LVM", "programs", "open_lvm", "lvm_read", "formats", True),
        (".mcap", "MCAP", "topics", "open_bag", "rosbags", "formats", True),
        (".bag", "bag of ROS 1", "topics", "open_bag", "rosbags", "formats", True),
        (".ulg", "ULog", "topics", "open_ulog", "pyulog", "formats", True),
        (".json .jsonl .ndjson", "JSON", "records", "open_json", "", "", True),
        (".feather .arrow .ipc", "Feather", "records", "open_feather", "", "", True),
        (".npz .npy", "NumPy", "records", "open_numpy", "", "", True),
        (".trace", "trace", "traces", "open_trace"),
        (".halscope", "halscope log", "traces", "open_halscope"),
        (".db .sqlite .sqlite3 .db3", "SQLite", "records", "open_sqlite", "", "", True),
    )
    for suffix in suffixes.split()
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
    b"LabVIEW Measurement": "LVM",
    b"\x89MCAP0\r\n": "MCAP",
    b"ULog\x01": "ULog",
    b"ARROW1": "Feather",
    b"\x93NUMPY": "NumPy",
    b"SQLite format 3": "SQLite",
    b"[key]": "trace",
    b"# Sampling period is": "halscope log",
    b"Sampling period is": "halscope log",
    b"#ROSBAG V": "bag of ROS 1",
}
COMPATIBLE_KINDS = {
    ("MAT", "HDF5"),
    ("Excel", "ZIP archive or Excel workbook"),
    ("NumPy", "ZIP archive or Excel workbook"),
    ("Excel", "Excel workbook"),
    ("HDF5", "MAT"),
}


def readable_suffixes() -> list[str]:
    """Return the suffixes of the files that can be read with what is installed, those of other packages last."""
    others = (f".{point.name.lower()}" for point in entry_points(group=ENTRY_POINTS))
    installed = (suffix for suffix, reader in BUILT_IN.items() if reader.installed)
    return list(dict.fromkeys([*installed, *ARCHIVES, *others]))


def open_file(path: str | Path, text: TextLayout | None = None) -> TableFile:
    """Open a file, also one in an archive (``log.zip/day.csv``, ``log.csv.gz``), or a table by its address.

    Its rows are not read yet. `text`: what the user says of the layout of a text file.

    Raises RecordingError if the file cannot be read, is empty, or is not what its suffix says.
    """
    path, table = Path(path), open_address(str(path), text)
    if table is not None:
        return table
    if path.is_dir():
        raise RecordingError(f"{path}: is a directory, give a recording in it")
    if archive_of(path) is not None:
        return unpack(path, lambda inside: _open_plain(inside, text))
    return _open_plain(path, text)


def _open_plain(path: Path, text: TextLayout | None) -> TableFile:
    try:
        if not stat.S_ISREG(path.stat().st_mode):  # nobody may ever write into a pipe
            raise RecordingError(f"{path}: is a pipe or a device, write what comes out of it to a file first")
        with path.open("rb") as file:
            head = file.read(65536)
    except FileNotFoundError:
        raise RecordingError(f"{path}: no such file, check the path of the recording") from None
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror or error})") from None
    if not head.strip():
        raise EmptyRecordingError(f"{path}: is empty")
    suffix = path.suffix.lower()
    reader = BUILT_IN.get(suffix)
    if reader is not None and reader.format == "CSV" and head.lstrip()[:1] == b"{" and b"}" in head:
        reader = BUILT_IN[".json"]  # many programs write records as lines of a log
    if reader is not None and reader.format == "CSV" and (kind := _recognise(head.lstrip(b"\xef\xbb\xbf"))):
        reader = {"trace": BUILT_IN[".trace"], "halscope log": BUILT_IN[".halscope"]}.get(kind, reader)
    if reader is not None:
        _check_format(path, head, reader.format)
        opened = reader.open(path, text)
    else:  # looked up only now: it takes a hundredth of a second
        other = next((point for point in entry_points(group=ENTRY_POINTS) if f".{point.name.lower()}" == suffix), None)
        if other is None:
            kind = _recognise(head)
            what = f", it looks like a {kind}" if kind else ""
            known = ", ".join(readable_suffixes())
            raise RecordingError(f"{path}: unknown kind of file {path.suffix!r}{what}; readable are {known}")
        opener: Callable[[Path], TableFile] = other.load()
        opened = opener(path)
    opened = widen(opened)
    if not opened.columns:
        raise RecordingError(f"{path}: holds no columns of numbers")
    return opened


def _recognise(head: bytes) -> str | None:
    """Return what a file is by its first bytes; None for text."""
    name = next((kind for magic, kind in MAGIC.items() if head.startswith(magic)), None)
    if name is None and head[:256].lstrip(b"\xef\xbb\xbf \r\n\t").lower().startswith(
        (b"<!doctype", b"<html", b"<?xml", b"<svg")
    ):
        return "HTML or XML page"
    if name is None and b"\0" in head and not head.startswith((b"\xff\xfe", b"\xfe\xff")) and not is_utf16(head):
        return "binary file"
    return name


def _check_format(path: Path, head: bytes, wanted: str) -> None:
    kind = _recognise(head)
    if kind == wanted or (wanted, kind) in COMPATIBLE_KINDS or (wanted in ("CSV", "JSON") and kind in (None, "LVM")):
        return
    suffix = next((suffix for suffix, reader in BUILT_IN.items() if reader.format == kind), None)
    advice = {
        "MDF file that its recorder never finished": "finalize it with the recorder's own tool",
        "gzip archive": f"rename it to {path.name}.gz",
    }.get(kind or "", f"rename it to {suffix}" if suffix else f"export it as {wanted}")
    raise RecordingError(f"{path}: is not {wanted} but a {kind or 'text file'}: {advice}")
