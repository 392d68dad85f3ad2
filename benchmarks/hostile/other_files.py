"""Files that name another file, by format: whoever sends one must learn nothing of the file that it names."""

from __future__ import annotations

import gzip
import io
import pickle
import shutil
import struct
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["FORMATS", "leaked", "other_files", "plant"]

WORD = b"SeCrEt7!"
ROWS = 50
VALUE = struct.unpack("<d", WORD)[0]
SHOWN = (WORD.decode(), f"{VALUE:.5e}"[:6], ", ".join(str(float(x)) for x in WORD[:4]), ", ".join(map(str, WORD[:4])))


def plant(folder: Path) -> tuple[Path, Path]:
    """Write a secret as bytes and as HDF5 file, and return both."""
    import h5py

    raw, hdf5 = folder / "secret.bin", folder / "secret.h5"
    raw.write_bytes(WORD * ROWS)
    with h5py.File(hdf5, "w") as file:
        file["y"] = np.full(ROWS, VALUE)
    return raw, hdf5


def leaked(answer: str) -> bool:
    """Tell whether an answer has something of the secret."""
    return any(word in answer for word in SHOWN)


def other_files(kind: str, folder: Path) -> list[bytes]:
    """Return files of a format that name the secret, which is planted in a folder."""
    raw, hdf5 = plant(folder)
    return [content for write in FORMATS.get(kind, ()) for content in write(raw, hdf5)]


def _hdf5(raw: Path, hdf5: Path) -> Iterator[bytes]:
    yield from _hdf5_files(raw, hdf5, b"")


def _mat(raw: Path, hdf5: Path) -> Iterator[bytes]:
    yield from _hdf5_files(raw, hdf5, b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(128))


def _hdf5_files(raw: Path, hdf5: Path, head: bytes) -> Iterator[bytes]:
    import h5py

    def external(group: Any, name: str = "y", kind: str = "f8") -> Any:
        size = len(WORD) * ROWS // np.dtype(kind).itemsize
        made = group.create_dataset(name, (size,), kind, external=[(str(raw), 0, len(WORD) * ROWS)])
        made.attrs["MATLAB_class"] = np.bytes_("double")
        return made

    def virtual(group: Any) -> None:
        layout = h5py.VirtualLayout((ROWS,), "f8")
        layout[:] = h5py.VirtualSource(str(hdf5), "y", (ROWS,))
        group.create_virtual_dataset("y", layout)

    def link(group: Any) -> None:
        group["y"] = h5py.ExternalLink(str(hdf5), "/y")

    def soft(group: Any) -> None:
        group["there"] = h5py.ExternalLink(str(hdf5), "/")
        group["y"] = h5py.SoftLink("/there/y")

    def hidden(group: Any, kind: str = "f8") -> Any:
        return external(group.create_group("hidden"), kind=kind).ref  # the link to this group is taken away below

    def cell(group: Any, *, objects: bool = False) -> None:
        cells = group.create_dataset("y", data=np.array([hidden(group)], h5py.ref_dtype))
        cells.attrs["MATLAB_class"] = np.bytes_("cell")
        if objects:
            group.create_group("#subsystem#")

    def fields(group: Any) -> None:
        group.create_group("y").attrs["MATLAB_fields"] = hidden(group, "u1")

    ways: tuple[Callable[[Any], object], ...] = (
        external,
        lambda file: external(file, kind="u1"),
        lambda file: external(file.create_group("a/b")),
        lambda file: external(file.create_group("#refs#")),
        virtual,
        link,
        soft,
        cell,
        lambda file: cell(file, objects=True),
        fields,
    )
    for way in ways:
        memory = io.BytesIO()
        with h5py.File(memory, "w", userblock_size=512 if head else 0) as file:
            file["t"] = 0.01 * np.arange(ROWS)
            way(file)
            file.flush()
            places = [h5py.h5o.get_info(file[name].id).addr for name in ("hidden", "t") if name in file]
        content = memory.getvalue()
        if len(places) == 2:  # references alone lead to the group then
            content = content.replace(*(struct.pack("<Q", place) for place in places))
        yield head + content[len(head) :]


def _mdf(raw: Path, _: Path) -> Iterator[bytes]:
    from asammdf import MDF, Signal

    for name in (str(raw), raw.name):
        with tempfile.TemporaryDirectory() as folder, MDF(version="4.10") as file:
            t, words = 0.01 * np.arange(ROWS), Path(folder) / "log.mf4"
            marker = "-" * len(name)
            file.attach(b"embedded", file_name=marker, mime="text/plain")
            file.append([Signal(t, t, name="y", attachment=(b"none", Path(marker), b""))])
            file.save(words, overwrite=True)
            content = words.read_bytes().replace(marker.encode(), name.encode())
        at = content.find(b"##AT")
        while at >= 0:  # no longer embedded
            links = struct.unpack_from("<Q", content, at + 16)[0]
            flags = at + 24 + 8 * links
            content = content[:flags] + bytes(2) + content[flags + 2 :]
            at = content.find(b"##AT", at + 4)
        yield content


def _parquet(raw: Path, _: Path) -> Iterator[bytes]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    with tempfile.TemporaryDirectory() as folder:
        whole, description = Path(folder) / "whole.parquet", Path(folder) / "description.parquet"
        pq.write_table(pa.table({"t": 0.01 * np.arange(ROWS), "y": np.zeros(ROWS)}), whole)
        metadata = pq.read_metadata(whole)
        metadata.set_file_path(str(raw))
        metadata.write_metadata_file(description)
        yield description.read_bytes()
        rest = whole.read_bytes()
        yield rest[: -8 - int.from_bytes(rest[-8:-4], "little")] + description.read_bytes()[4:]


def _zipped(members: Mapping[str, bytes], links: Mapping[str, str] | None = None) -> bytes:
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
        for name, target in (links or {}).items():
            about = zipfile.ZipInfo(name)
            about.create_system, about.external_attr = 3, 0o120777 << 16
            archive.writestr(about, target)
    return memory.getvalue()


def _excel(raw: Path, _: Path) -> Iterator[bytes]:
    import xlsxwriter

    memory = io.BytesIO()
    with xlsxwriter.Workbook(memory) as book:
        sheet = book.add_worksheet()
        for k, name in enumerate("ty"):
            sheet.write(0, k, name)
            sheet.write_column(1, k, 0.01 * np.arange(ROWS))
        sheet.write_formula("C1", f"='[{raw}]Sheet1'!A1")
        sheet.write_formula("C2", f'=DDE("soffice","{raw}","A1")')
        sheet.write_formula("C3", f'=WEBSERVICE("file://{raw}")')
    with zipfile.ZipFile(memory) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    yield memory.getvalue()
    entity = f'<!DOCTYPE x [<!ENTITY e SYSTEM "file://{raw}">]>'.encode()
    name = "xl/worksheets/sheet1.xml"
    head, _, rest = members[name].partition(b"<worksheet")
    told = rest.replace(b"<sheetData>", b'<sheetData><row r="1"><c r="D1" t="inlineStr"><is><t>&e;</t></is></c></row>')
    yield _zipped({**members, name: head + entity + b"<worksheet" + told})


def _zip(raw: Path, _: Path) -> Iterator[bytes]:
    for name in ("log.csv", f"../{raw.name}", str(raw), ".."):
        yield _zipped({}, {name: str(raw)})
    yield _zipped({"log.csv": b"t,y\n0,1\n"}, {"y.csv": f"../{raw.name}"})


def _gzip(raw: Path, _: Path) -> Iterator[bytes]:
    memory = io.BytesIO()
    with gzip.GzipFile(str(raw), "wb", fileobj=memory) as file:
        file.write(b"t,y\n0,1\n1,2\n")
    yield memory.getvalue()


def _csv(raw: Path, _: Path) -> Iterator[bytes]:
    yield f"t,y\n0,=HYPERLINK(\"file://{raw}\")\n1,='[{raw}]Sheet1'!A1\n".encode()
    yield f"@{raw}\n".encode()


def _tdms(raw: Path, _: Path) -> Iterator[bytes]:
    from nptdms import ChannelObject, TdmsWriter

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.tdms"
        for name, index in (("y", False), (WORD.decode(), True)):  # the description beside has other names
            with TdmsWriter(str(path), index_file=index) as file:
                file.write_segment([ChannelObject("rig", x, 0.01 * np.arange(ROWS)) for x in ("t", name)])
            if not index:
                yield path.read_bytes()
        shutil.copyfile(f"{path}_index", raw.parent / "TDMS.tdms_index")


def _lvm(raw: Path, _: Path) -> Iterator[bytes]:
    (raw.parent / "LVM.lvm.pkl").write_bytes(pickle.dumps({0: {"Channel names": ["t", WORD.decode()]}}))
    head = "LabVIEW Measurement\t\nSeparator\tTab\nDecimal_Separator\t.\nX_Columns\tOne\n***End_of_Header***\t\n\t\n"
    rows = "\n".join(f"{0.01 * k}\t{k}" for k in range(ROWS))
    yield f"{head}Channels\t1\n***End_of_Header***\t\nX_Value\ty\tComment\n{rows}\n".encode()


FORMATS: Mapping[str, tuple[Callable[[Path, Path], Iterator[bytes]], ...]] = {
    "CSV": (_csv,),
    "Parquet": (_parquet,),
    "MAT 7.3": (_mat,),
    "MDF": (_mdf,),
    "TDMS": (_tdms,),
    "HDF5": (_hdf5,),
    "Excel": (_excel,),
    "LVM": (_lvm,),
    "gzip": (_gzip,),
    "ZIP": (_zip,),
}
