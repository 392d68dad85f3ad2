"""Blocks as bytes of a message: compact binary, or JSON; read without trusting a single byte.

Binary, little-endian:

    offset  bytes  what
         0      4  "SVSB"
         4      1  version, 1
         5      1  flags: 1 sender keeps blocks, 2 a time stamp per sample, 4 samples as binary32 instead of binary64
         6      2  0
         8      4  N, number of samples
        12      4  CRC-32 of all that follows
        16      8  stream
        24      8  sequence
        32      8  oldest: of the blocks that the sender keeps; 0 where it keeps none
        40      8  time of the first sample, binary64 [UTC s]
        48      8  sample time, binary64 [s]; 0 where there is a time stamp per sample
        56         time stamps, N binary64, if flag 2 is set; then r, u and y, N numbers each
"""

from __future__ import annotations

import json
import math
import struct
import zlib
from typing import Any, NamedTuple

import numpy as np

from servoscope.errors import MessageError
from servoscope.live.block import Block
from servoscope.plants import FloatArray

__all__ = ["LATEST", "Received", "decode", "encode", "to_json"]

MAGIC, VERSION = b"SVSB", 1
HEAD = struct.Struct("<4sBBHII")
REST = struct.Struct("<QQQdd")
KEEPS, STAMPED, SINGLE = 1, 2, 4
LARGEST = 2**63 - 1  # what a database can count
LATEST = 253402300800.0  # s: the year 10000, from which on calendars end
KEYS = {"version", "stream", "sequence", "oldest", "t", "t0", "dt", "r", "u", "y"}


class Received(NamedTuple):
    """A block as it came, and the oldest that its sender still keeps; None: it keeps none."""

    block: Block
    oldest: int | None


def encode(block: Block, oldest: int | None = None) -> bytes:
    """Return a block as a binary message; `decode` gives it back bit by bit."""
    n, stamps = block.t.size, block.t
    dt = float(stamps[1] - stamps[0]) if n > 1 else 1.0
    uniform = dt > 0.0 and bool((stamps == stamps[0] + dt * np.arange(n)).all())
    flags = (0 if oldest is None else KEEPS) | (0 if uniform else STAMPED)
    body = REST.pack(block.stream, block.sequence, oldest or 0, float(stamps[0]), dt if uniform else 0.0)
    columns = [block.r, block.u, block.y] if uniform else [stamps, block.r, block.u, block.y]
    body += np.stack(columns).astype("<f8").tobytes()
    return HEAD.pack(MAGIC, VERSION, flags, 0, n, zlib.crc32(body)) + body


def to_json(block: Block, oldest: int | None = None) -> bytes:
    """Return a block as a JSON message."""
    plain: dict[str, Any] = {"version": VERSION, "stream": block.stream, "sequence": block.sequence}
    if oldest is not None:
        plain["oldest"] = oldest
    for name in "truy":
        plain[name] = [x if math.isfinite(x) else None for x in getattr(block, name).tolist()]
    return json.dumps(plain, separators=(",", ":"), allow_nan=False).encode()


def decode(asset: str, message: bytes, due: float = 0.0) -> Received:
    """Return the block of a message.

    Parameters
    ----------
    asset
        Whose it is.
    message
        Binary or JSON. Nothing is taken for granted: memory is taken for what is there, not for what is announced.
    due
        When it came, by the monotonic clock [s].

    Raises
    ------
    MessageError
        If it is anything else.
    """
    if message[:4] == MAGIC:
        return _binary(asset, message, due)
    if message[:1] in (b"{", b" ", b"\n", b"\r", b"\t"):
        return _json(asset, message, due)
    raise MessageError("not a block", f"begins with {message[:8]!r}: neither a binary block nor a JSON object")


def _binary(asset: str, message: bytes, due: float) -> Received:
    if len(message) < HEAD.size + REST.size:
        raise MessageError("truncated", f"{len(message)} bytes, a binary block has at least {HEAD.size + REST.size}")
    _, version, flags, zero, n, checksum = HEAD.unpack_from(message)
    if version != VERSION:
        raise MessageError("version", f"binary block of version {version}, only {VERSION} is known")
    if flags & ~(KEEPS | STAMPED | SINGLE) or zero:
        raise MessageError("not a block", f"flags {flags} and {zero}: some of them have no meaning")
    width = 4 if flags & SINGLE else 8
    stamps = 8 * n if flags & STAMPED else 0
    expected = HEAD.size + REST.size + stamps + 3 * width * n
    if len(message) != expected:
        kind = "truncated" if len(message) < expected else "oversized"
        raise MessageError(kind, f"{len(message)} bytes, {n} samples need {expected}")
    body = memoryview(message)[HEAD.size :]
    if zlib.crc32(body) != checksum:
        raise MessageError("checksum", "the CRC-32 does not fit, the message is damaged")
    stream, sequence, oldest, t0, dt = REST.unpack_from(body)
    at = REST.size + stamps
    t = np.frombuffer(body[REST.size : at], "<f8").astype(np.float64) if stamps else _uniform(t0, dt, n)
    numbers = np.frombuffer(body[at:], f"<f{width}").astype(np.float64).reshape(3, -1)
    return _checked(asset, stream, sequence, oldest if flags & KEEPS else None, t, numbers, due)


def _json(asset: str, message: bytes, due: float) -> Received:
    try:
        plain = json.loads(message)
    except (ValueError, RecursionError) as error:
        raise MessageError("not a block", f"no JSON: {' '.join(str(error).split())[:100]}") from None
    if not isinstance(plain, dict):
        raise MessageError("not a block", "JSON, but no object")
    if strange := set(plain) - KEYS:
        raise MessageError("keys", f"unknown key {min(strange)[:40]!r}, choose from {', '.join(sorted(KEYS))}")
    if plain.get("version") != VERSION:
        raise MessageError("version", f"version {str(plain.get('version'))[:20]!r}, only {VERSION} is known")
    stream, sequence = _whole(plain, "stream", 0), _whole(plain, "sequence", None)
    oldest = None if plain.get("oldest") is None else _whole(plain, "oldest", None)
    numbers = np.stack(_columns(plain, ("r", "u", "y")))
    if "t" in plain:
        (t,) = _columns(plain, ("t",))
    else:
        t = _uniform(_number(plain, "t0"), _number(plain, "dt"), numbers.shape[1])
    return _checked(asset, stream, sequence, oldest, t, numbers, due)


def _whole(plain: dict[str, Any], name: str, otherwise: int | None) -> int:
    value = plain.get(name, otherwise)
    if not isinstance(value, int) or isinstance(value, bool):
        raise MessageError("wrong type", f"{name}: missing, or no whole number")
    return value


def _number(plain: dict[str, Any], name: str) -> float:
    value = plain.get(name)
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise MessageError("wrong type", f"{name}: missing, or no number; give t, or t0 and dt")
    try:
        return float(value)
    except OverflowError:
        raise MessageError("wrong type", f"{name}: no number that a computer can hold") from None


def _columns(plain: dict[str, Any], names: tuple[str, ...]) -> list[FloatArray]:
    found = []
    for name in names:
        values = plain.get(name)
        if not isinstance(values, list) or not set(map(type, values)) <= {int, float, type(None)}:
            raise MessageError("wrong type", f"{name}: missing, or no list of numbers and nulls")
        try:
            found.append(np.array([math.nan if x is None else x for x in values], dtype=np.float64))
        except OverflowError:
            raise MessageError("wrong type", f"{name}: holds a number that no computer can hold") from None
    if len({column.size for column in found}) > 1:
        raise MessageError("lengths", f"{', '.join(f'{x.size} of {n}' for n, x in zip(names, found, strict=True))}")
    return found


def _uniform(t0: float, dt: float, n: int) -> FloatArray:
    if not (0.0 <= t0 < LATEST and 0.0 < dt < LATEST):
        raise MessageError("times", f"t0 = {t0:g} and dt = {dt:g} are no clock")
    return t0 + dt * np.arange(n, dtype=np.float64)


def _checked(
    asset: str, stream: int, sequence: int, oldest: int | None, t: FloatArray, numbers: FloatArray, due: float
) -> Received:
    if not t.size:
        raise MessageError("empty", "no samples")
    if t.size != numbers.shape[1]:
        raise MessageError("lengths", f"{t.size} time stamps, {numbers.shape[1]} samples")
    for name, value in (("stream", stream), ("sequence", sequence), ("oldest", oldest or 0)):
        if not 0 <= value <= LARGEST:
            raise MessageError("out of range", f"{name}: must lie between 0 and 2^63 - 1")
    if not ((t >= 0.0) & (t < LATEST)).all():
        raise MessageError("times", "a time stamp is missing, or outside of the years 1970 to 9999")
    r, u, y = numbers
    return Received(Block(asset, sequence, t, r, u, y, due, stream, oldest is not None), oldest)
