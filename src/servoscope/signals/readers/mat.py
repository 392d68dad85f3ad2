"""Reads MAT files.

Files of version 5 are checked first: SciPy trusts the types that they name, and a wrong one ends the process.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from servoscope.core.errors import RecordingError
from servoscope.signals.readers.table import Table, TableFile, shorten_error

HEADER_BYTES = 128  # bytes of text, version and byte order
TYPE_BYTES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8, 14: 1, 16: 1, 17: 2, 18: 4}  # bytes of one
MATRIX, COMPRESSED = 14, 15
MAX_DEPTH = 30  # structures in structures


def open_mat(path: Path) -> TableFile:
    """Open a MAT file, version 5 or 7.3."""
    import pyarrow as pa

    try:
        variables = dict(_flatten(_load_mat(path)))
    # SciPy and h5py raise nearly anything at damaged files, from MatReadError to AttributeError.
    except Exception as error:
        raise RecordingError(
            f"{path}: is a damaged or unknown MAT file ({shorten_error(error)}), save it again"
        ) from None
    lengths = [x.size for x in variables.values() if x.size > 1]
    # The channels are the vectors of the length that most of them, and of those the longest, have.
    rows = max(lengths, key=lambda size: (lengths.count(size), size), default=0)
    columns = {name: pa.chunked_array([x]) for name, x in variables.items() if x.size == rows}
    others = {name: f"has {x.size} values, the channels have {rows}" for name, x in variables.items() if x.size != rows}
    return TableFile(path, tuple(columns), lambda *_: iter([Table(path.name, columns)]), others)


def _load_mat(path: Path) -> Mapping[str, Any]:
    import h5py
    import scipy.io

    if not h5py.is_hdf5(path):
        check_mat5(path)
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


def _flatten(variables: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, npt.NDArray[Any]]]:
    """Walk variables and structs, ``motor.speed``; the columns of a matrix become ``x[0]``, ``x[1]``."""
    for key, value in variables.items():
        name = f"{prefix}{key}"
        array = value if isinstance(value, Mapping) else np.asarray(value)
        if isinstance(array, Mapping):
            yield from _flatten(array, f"{name}.")
        elif array.dtype.names and array.size == 1:
            yield from _flatten({part: array[part].item() for part in array.dtype.names}, f"{name}.")
        elif array.dtype.kind in "fiub" and array.ndim <= 2:
            plain = array.astype(array.dtype.newbyteorder("="))
            if plain.ndim < 2 or 1 in plain.shape:
                yield name, np.ascontiguousarray(plain.reshape(-1))
            else:
                for index in range(plain.shape[1]):
                    yield f"{name}[{index}]", np.ascontiguousarray(plain[:, index])


def check_mat5(path: Path) -> None:
    """Walk through all elements of a file.

    Raises ValueError if a type is unknown, or an element ends outside of what holds it; raises zlib.error if what
    is compressed cannot be unpacked.
    """
    data = memoryview(path.read_bytes())
    if len(data) < HEADER_BYTES or bytes(data[126:128]) not in (b"IM", b"MI"):
        return  # of an older version, or not to be read at all, which the reader tells
    order = "<" if bytes(data[126:128]) == b"IM" else ">"
    at = HEADER_BYTES
    while at + 8 <= len(data):
        kind, size = struct.unpack_from(order + "II", data, at)
        inside = data[at + 8 : at + 8 + size]
        if len(inside) < size:
            raise ValueError("cut off")
        if kind == COMPRESSED:
            unpacked = memoryview(zlib.decompress(inside))
            if len(unpacked) < 8:
                raise ValueError("nothing inside")
            kind, size = struct.unpack_from(order + "II", unpacked)
            inside = unpacked[8 : 8 + size]
        if kind != MATRIX:
            raise ValueError(f"element of type {kind}")
        _check_elements(inside, order, 0)
        at += 8 + struct.unpack_from(order + "I", data, at + 4)[0]


def _check_elements(inside: memoryview, order: str, depth: int) -> None:
    """Check the elements of a matrix."""
    if depth > MAX_DEPTH:
        raise ValueError("structures too deep")
    at = 0
    while at + 8 <= len(inside):
        kind, size = struct.unpack_from(order + "II", inside, at)
        begin = at + 8
        if kind >> 16:  # a short one, in four bytes behind its size
            kind, size, begin = kind & 0xFFFF, kind >> 16, at + 4
            if size > 4:
                raise ValueError("a short element of more than four bytes")
        if size % TYPE_BYTES.get(kind, size + 1) or begin + size > len(inside):
            raise ValueError(f"element of type {kind} and {size} bytes")
        if kind == MATRIX:
            _check_elements(inside[begin : begin + size], order, depth + 1)
        at = at + 8 if begin == at + 4 else begin + size + -size % 8
