"""Reads MAT files, also with timetables and records of dSPACE ControlDesk, and other HDF5 files."""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.core.errors import RecordingError
from servoscope.signals.readers.matrices import split_matrices
from servoscope.signals.readers.table import NUMBER_BYTES, TableFile, check_bytes, one_line_errors
from servoscope.signals.readers.units import split_unit, with_unit

HEADER_BYTES, COMPRESSED, PIECE_BYTES = 128, 15, 1 << 20  # of a MAT file of version 5
IN_OTHER_FILE = "lies in another file, which is not read: save all data in one file"


def open_mat(path: Path) -> TableFile:
    """Open a MAT file, version 5 or 7.3, also with objects such as timetables."""
    return _open_variables(path, "MAT", _load_mat)


def open_hdf5(path: Path) -> TableFile:
    """Open an HDF5 file: its datasets, tables with named columns among them, and frames of pandas."""
    return _open_variables(path, "HDF5", lambda path: _load_hdf5(path, matlab=False))


def _open_variables(path: Path, kind: str, load: Callable[[Path], Mapping[str, Any]]) -> TableFile:
    """Open a file whose variables are read at once."""
    with one_line_errors(path, f"is a damaged or unknown {kind} file", "save it again"):
        variables = split_matrices(dict(_flatten(load(path))))
    lengths = [x.size for x in variables.values() if x.size > 1]
    # The channels are the vectors of the length that most of them, and of those the longest, have.
    rows = max(lengths, key=lambda size: (lengths.count(size), size), default=0)
    columns = {name: x for name, x in variables.items() if x.size == rows}
    others = {name: f"has {x.size} values, the channels have {rows}" for name, x in variables.items() if x.size != rows}
    aliases = {bare: name for name in columns if (bare := split_unit(name)[0]) not in columns}
    return TableFile.from_columns(path, columns, non_channels=others, aliases=aliases)


def _load_mat(path: Path) -> dict[str, Any]:
    import h5py
    import scipy.io

    if h5py.is_hdf5(path):
        loaded = _load_hdf5(path, matlab=True)
        with h5py.File(path, "r") as file:
            has_objects = "#subsystem#" in file
    else:
        _check_unpacked(path)
        loaded = scipy.io.loadmat(path, squeeze_me=False)
        has_objects = any(name == "__function_workspace__" or _is_object(x) for name, x in loaded.items())
    if has_objects:
        if find_spec("matio") is None:
            raise ValueError("it holds objects, such as timetables: pip install 'servoscope[formats]'")
        loaded |= _load_objects(path)
    return {n: value for n, value in loaded.items() if not n.startswith(("__", "#")) and not _is_object(value)}


def _check_unpacked(path: Path) -> None:
    """Refuse a MAT file of version 5 whose variables need improbably much memory when unpacked; raises RecordingError.

    Source: MathWorks, "MAT-File Format", level 5: elements of type 15 are compressed by zlib.
    """
    total = 0
    with path.open("rb") as file:
        order = "<" if file.read(HEADER_BYTES)[-2:] == b"IM" else ">"
        while len(tag := file.read(8)) == 8:
            kind, size = struct.unpack(f"{order}II", tag)
            end = file.tell() + size
            if kind == COMPRESSED:
                unpacker, packed = zlib.decompressobj(), b""
                while not unpacker.eof and (packed := unpacker.unconsumed_tail or file.read(min(PIECE_BYTES, size))):
                    total += len(unpacker.decompress(packed, PIECE_BYTES))
                    check_bytes(path, total, "variables")
            file.seek(end)


def _is_object(value: Any) -> bool:
    """Tell whether a variable is an object of MATLAB, which SciPy does not read."""
    return type(value).__name__ == "MatlabOpaque" or getattr(getattr(value, "dtype", None), "names", None) == (
        "s0", "s1", "s2", "arr",
    )  # fmt: skip


def _load_objects(path: Path) -> dict[str, Any]:
    """Return tables and timetables as mappings of their columns."""
    from matio import load_from_mat

    objects = {}
    for name, value in load_from_mat(str(path)).items():
        if hasattr(value, "columns") and hasattr(value, "index"):  # a frame of pandas
            columns = {str(column): np.asarray(value[column]) for column in value.columns}
            if value.index.dtype.kind in "mM":  # of a timetable
                columns = {str(value.index.name or "Time"): np.asarray(value.index)} | columns
            objects[name] = columns
    return objects


def _load_hdf5(path: Path, matlab: bool) -> dict[str, Any]:
    import h5py

    def group(node: Any) -> dict[str, Any]:
        inner: dict[str, Any] = {}
        for name, item in node.items():
            if isinstance(item, h5py.Group):
                if not name.startswith("#"):
                    inner[name] = group(item)
            elif (
                item.attrs.get("MATLAB_class", b"double") not in (b"char", b"cell")
                and "MATLAB_object_decode" not in item.attrs
            ):
                values = np.asarray(item[()])
                inner[name] = values.T if matlab else values  # MATLAB counts columns first
        return _frame_columns(inner)

    with h5py.File(path, "r") as file:
        refuse_other_files(path, file)
        return group(file)


def refuse_other_files(path: Path, file: Any) -> None:
    """Refuse an HDF5 file of which a part lies in another file: what is read could be any file of this machine.

    And one whose datasets claim improbably many values.

    All that links or references lead to is looked at, before any values are read. A link to a name within the file
    needs no look: what it names has a link of its own, if it is there.
    """
    import h5py

    known, values = set[int](), 0
    waiting: list[tuple[Any, Any]] = [(file, "/")]
    while waiting:
        group, key = waiting.pop()
        if isinstance(key, str):
            link = group.get(key, getlink=True) if key != "/" else None
            if isinstance(link, h5py.SoftLink):
                continue
            if isinstance(link, h5py.ExternalLink):
                raise RecordingError(f"{path}: {key!r} {IN_OTHER_FILE}")
        node = group[key]
        if hash(node.id) in known:
            continue
        known.add(hash(node.id))
        if isinstance(node, h5py.Dataset):
            values += (node.size or 0) * max(NUMBER_BYTES, node.dtype.itemsize)
            check_bytes(path, values, "values")
        references = [node.attrs[name] for name in node.attrs if h5py.check_ref_dtype(node.attrs.get_id(name).dtype)]
        if isinstance(node, h5py.Group):
            waiting += ((node, name) for name in node)
        elif isinstance(node, h5py.Dataset):
            if node.is_virtual or node.external:
                raise RecordingError(f"{path}: {node.name or 'a cell'!r} {IN_OTHER_FILE}")
            references += [node[()]] if h5py.check_ref_dtype(node.dtype) else []
        waiting += ((file, target) for values in references for target in np.ravel(values) if target)


def _frame_columns(node: dict[str, Any]) -> dict[str, Any]:
    """Return a frame as pandas stores it, blocks with the names of their columns, as a mapping of its columns."""
    blocks = [name.removesuffix("_values") for name in node if re.fullmatch(r"block\d+_values", name)]
    if not blocks or "axis1" not in node:
        return node
    columns: dict[str, Any] = {}
    for block in blocks:
        names = [x.decode() if isinstance(x, bytes) else str(x) for x in node[f"{block}_items"].reshape(-1).tolist()]
        columns |= {name: node[f"{block}_values"][:, k] for k, name in enumerate(names)}
    return {"index": node["axis1"], **columns}


def _flatten(variables: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, npt.NDArray[Any]]]:
    """Walk variables and structs, ``motor.speed``; matrices are whole yet."""
    for key, value in variables.items():
        name = f"{prefix}{key}"
        array = value if isinstance(value, Mapping) else np.asarray(value)
        if isinstance(array, Mapping):
            yield from _flatten(array, f"{name}.")
        elif array.dtype.names and {"Name", "Data"} <= set(array.dtype.names):
            yield from _control_desk_channels(array, name)
        elif array.dtype.names and array.size == 1:
            yield from _flatten({part: array[part].item() for part in array.dtype.names}, f"{name}.")
        elif array.dtype.names and array.ndim == 1:  # a table, as PyTables and h5py write it
            yield from _flatten(
                {part: array[part] for part in array.dtype.names}, prefix if key == "table" else f"{name}."
            )
        elif array.dtype.kind in "mM" and array.ndim == 1:
            since = (
                (array - array[:1]) / np.timedelta64(1, "ns")
                if array.dtype.kind == "M"
                else array / np.timedelta64(1, "ns")
            )
            yield name, np.asarray(since * 1e-9, dtype=np.float64)
        elif array.dtype.kind in "fiub" and array.ndim <= 2:
            plain = array.astype(array.dtype.newbyteorder("="))
            yield name, np.ascontiguousarray(plain.reshape(-1) if plain.ndim < 2 or 1 in plain.shape else plain)


def _control_desk_channels(records: npt.NDArray[Any], name: str) -> Iterator[tuple[str, npt.NDArray[Any]]]:
    """Walk the axes or signals of a measurement of dSPACE ControlDesk, structs with Name and Data.

    Source: dSPACE, ControlDesk Measurement and Recording, "Structure of the MAT file": X are time axes, Y signals.
    """
    for record in records.reshape(-1):
        values = np.asarray(record["Data"]).reshape(-1)
        label = "".join(map(str, np.asarray(record["Name"]).reshape(-1)))
        label = re.sub(r'^.*?([^/"]+)"?\s*$', r"\1", label) or name
        if "Unit" in (records.dtype.names or ()):
            label = with_unit(label, "".join(map(str, np.asarray(record["Unit"]).reshape(-1))))
        if values.dtype.kind in "fiub":
            is_axis = name.rpartition(".")[2] == "X"
            yield "time" if is_axis else label, np.ascontiguousarray(values.astype(values.dtype.newbyteorder("=")))
