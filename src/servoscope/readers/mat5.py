"""Whether a MAT file of version 5 holds together: SciPy takes types on trust, and a wrong one ends the process."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

__all__ = ["check"]

HEAD = 128  # bytes of text, version and byte order
TYPES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8, 14: 1, 16: 1, 17: 2, 18: 4}  # bytes of one
MATRIX, COMPRESSED = 14, 15
DEEPEST = 30  # structures in structures


def check(path: Path) -> None:
    """Walk through all elements of a file.

    Raises
    ------
    ValueError
        If a type is unknown, or an element ends outside of what holds it.
    zlib.error
        If what is compressed cannot be unpacked.
    """
    data = memoryview(path.read_bytes())
    if len(data) < HEAD or bytes(data[126:128]) not in (b"IM", b"MI"):
        return  # of an older version, or not to be read at all, which the reader tells
    order = "<" if bytes(data[126:128]) == b"IM" else ">"
    at = HEAD
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
        _walk(inside, order, 0)
        at += 8 + struct.unpack_from(order + "I", data, at + 4)[0]


def _walk(inside: memoryview, order: str, depth: int) -> None:
    """Check the elements of a matrix."""
    if depth > DEEPEST:
        raise ValueError("structures too deep")
    at = 0
    while at + 8 <= len(inside):
        kind, size = struct.unpack_from(order + "II", inside, at)
        begin = at + 8
        if kind >> 16:  # a short one, in four bytes behind its size
            kind, size, begin = kind & 0xFFFF, kind >> 16, at + 4
            if size > 4:
                raise ValueError("a short element of more than four bytes")
        if size % TYPES.get(kind, size + 1) or begin + size > len(inside):
            raise ValueError(f"element of type {kind} and {size} bytes")
        if kind == MATRIX:
            _walk(inside[begin : begin + size], order, depth + 1)
        at = at + 8 if begin == at + 4 else begin + size + -size % 8
