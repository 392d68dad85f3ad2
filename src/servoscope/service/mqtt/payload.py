"""Blocks as bytes of a message: compact binary, or JSON; read without trusting a single byte.

Binary, little-endian:

    offset  bytes  what
         0      4  "SVSB"
         4      1  version, 1
         5      1  flags: 1 sender keeps blocks, 2 a time stamp per sample, 4 samples as binary32 instead of binary64
         6      2  k, number of further columns: the covariates that the loop file names, in its order
         8      4  N, number of samples
        12      4  CRC-32 of all that follows
        16      8  stream
        24      8  sequence
        32      8  oldest: of the blocks that the sender keeps; 0 where it keeps none
        40      8  time of the first sample, binary64 [UTC s]
        48      8  sample time, binary64 [s]; 0 where there is a time stamp per sample
        56         time stamps, N binary64, if flag 2 is set; then r, u, y and k further columns, N numbers each
"""

from __future__ import annotations

import json
import math
import struct
import zlib
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.util import find_spec
from typing import Any

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import ConfigError, MessageError
from servoscope.service.mqtt.topics import data_topic, parse_asset
from servoscope.service.sources.block import MAX_COUNT, MAX_TIME_S, Block
from servoscope.service.sources.message import Content, Decoder, InboxMessage, SourceAsset

MAGIC, VERSION = b"SVSB", 1
HEADER = struct.Struct("<4sBBHII")
BODY_HEADER = struct.Struct("<QQQdd")
FLAG_RETAINED, FLAG_TIMES, FLAG_BINARY32 = 1, 2, 4
COUNTS = ("stream", "sequence", "oldest")
JSON_KEYS = {"version", "stream", "sequence", "oldest", "t", "t0", "dt", "r", "u", "y", "covariates"}
REGULAR_KEYS = JSON_KEYS - {"covariates"}


def encode_binary(block: Block, oldest: int | None = None) -> bytes:
    """Return a block as a binary message; `decode_block` gives it back bit by bit."""
    n, stamps = block.t.size, block.t
    dt = float(stamps[1] - stamps[0]) if n > 1 else 1.0
    uniform = dt > 0.0 and bool((stamps == stamps[0] + dt * np.arange(n)).all())
    flags = (0 if oldest is None else FLAG_RETAINED) | (0 if uniform else FLAG_TIMES)
    body = BODY_HEADER.pack(block.stream, block.sequence, oldest or 0, float(stamps[0]), dt if uniform else 0.0)
    columns = [*([] if uniform else [stamps]), block.r, block.u, block.y, *block.covariates]
    body += np.stack(columns).astype("<f8").tobytes()
    return HEADER.pack(MAGIC, VERSION, flags, len(block.covariates), n, zlib.crc32(body)) + body


def encode_json(block: Block, oldest: int | None = None, covariates: Sequence[str] = ()) -> bytes:
    """Return a block as a JSON message; `covariates`: their names."""
    plain: dict[str, Any] = {"version": VERSION, "stream": block.stream, "sequence": block.sequence}
    if oldest is not None:
        plain["oldest"] = oldest
    for name in "truy":
        plain[name] = _plain_column(getattr(block, name))
    if covariates:
        plain["covariates"] = dict(zip(covariates, map(_plain_column, block.covariates), strict=True))
    return json.dumps(plain, separators=(",", ":"), allow_nan=False).encode()


def _plain_column(values: FloatArray) -> list[float | None]:
    return [x if math.isfinite(x) else None for x in values.tolist()]


def decode_block(
    asset: str,
    message: bytes,
    received_at: float = 0.0,
    covariates: Sequence[str] = (),
    *,
    alone: bool = False,
) -> Block:
    """Return the block of a message, binary or JSON, that came at `received_at` by the monotonic clock [s].

    `covariates`: names of the further columns that it must have; without them, further columns are left out; `alone`:
    JSON may leave out r, u and y, for which the first covariate stands. Memory is allocated for what is there, not for
    what a header announces. Raises MessageError if it is no block.
    """
    if message[:4] == MAGIC:
        return _decode_binary(asset, message, received_at, covariates)
    if message[:1] in (b"{", b" ", b"\n", b"\r", b"\t"):
        block = None if covariates else _decode_regular(asset, message, received_at)
        return _decode_json(asset, message, received_at, covariates, alone=alone) if block is None else block
    raise MessageError("not a block", f"begins with {message[:8]!r}: neither a binary block nor a JSON object")


def _decode_binary(asset: str, message: bytes, received_at: float, covariates: Sequence[str]) -> Block:
    if len(message) < HEADER.size + BODY_HEADER.size:
        shortest = HEADER.size + BODY_HEADER.size
        raise MessageError("truncated", f"{len(message)} bytes, a binary block has at least {shortest}")
    _, version, flags, further, n, checksum = HEADER.unpack_from(message)
    if version != VERSION:
        raise MessageError("version", f"binary block of version {version}, only {VERSION} is known")
    if flags & ~(FLAG_RETAINED | FLAG_TIMES | FLAG_BINARY32):
        raise MessageError("not a block", f"flags {flags}: some of them have no meaning")
    width = 4 if flags & FLAG_BINARY32 else 8
    stamps = 8 * n if flags & FLAG_TIMES else 0
    expected = HEADER.size + BODY_HEADER.size + stamps + (3 + further) * width * n
    if len(message) != expected:
        kind = "truncated" if len(message) < expected else "oversized"
        raise MessageError(kind, f"{len(message)} bytes, {n} samples need {expected}")
    body = memoryview(message)[HEADER.size :]
    if zlib.crc32(body) != checksum:
        raise MessageError("checksum", "the CRC-32 does not fit, the message is damaged")
    stream, sequence, oldest, t0, dt = BODY_HEADER.unpack_from(body)
    at = BODY_HEADER.size + stamps
    t = np.frombuffer(body[BODY_HEADER.size : at], "<f8") if stamps else _uniform_times(t0, dt, n)
    numbers = np.frombuffer(body[at:], f"<f{width}").reshape(3 + further, -1)
    if covariates and further != len(covariates):
        raise MessageError("covariates", f"{further} covariates, expected {', '.join(covariates)}")
    signals = _join_columns(t, numbers[: 3 + len(covariates)])
    return _build_block(asset, stream, sequence, oldest if flags & FLAG_RETAINED else None, signals, received_at)


@cache  # its memory is used again; while an error holds the document before, it refuses, and `_decode_json` reads
def _parser() -> Any:
    import simdjson

    return simdjson.Parser()


def _decode_regular(asset: str, message: bytes, received_at: float) -> Block | None:
    """Return what `_decode_json` returns, in a third of its time; None: not regular, which it knows more of.

    A message is regular if it has no covariates, each key once, and numbers alone in its lists.
    """
    try:
        document = _parser().parse(message)
        plain = {name: document[name] for name in document}  # to ask it for a key that it lacks takes long
        counts = version, stream, sequence, oldest = (
            plain["version"],
            plain.get("stream", 0),
            plain["sequence"],
            plain.get("oldest", 0),
        )
        columns = [plain[name] for name in ("truy" if "t" in plain else "ruy")]
        buffers = [column.as_buffer(of_type="d") for column in columns]
        signals = np.frombuffer(bytearray().join(buffers)).reshape(len(columns), -1)
    except (AttributeError, LookupError, TypeError, ValueError, RuntimeError):
        return None
    # a buffer makes one list of lists in lists; of a key that stands twice the last counts, not the first
    brackets = len(message) - len(message.replace(b"[", b""))  # in a sixth of the time of `message.count`
    are_flat = brackets == len(columns) and {*map(len, columns)} == {signals.shape[1]}
    are_known = len(plain) == len(document) and plain.keys() <= REGULAR_KEYS
    if not (are_flat and are_known and version == VERSION and {*map(type, counts)} == {int}):
        return None
    if len(columns) == 3:
        t = _uniform_times(_parse_number(plain, "t0"), _parse_number(plain, "dt"), signals.shape[1])
        signals = np.concatenate([t[None], signals])
    return _build_block(asset, stream, sequence, oldest if "oldest" in plain else None, signals, received_at)


def _decode_json(
    asset: str, message: bytes, received_at: float, covariates: Sequence[str], *, alone: bool = False
) -> Block:
    try:
        plain = parse_json(message)
    except (ValueError, RecursionError) as error:
        raise MessageError("not a block", f"no JSON: {' '.join(str(error).split())[:100]}") from None
    if not isinstance(plain, dict):
        raise MessageError("not a block", "JSON, but no object")
    if strange := set(plain) - JSON_KEYS:
        raise MessageError("keys", f"unknown key {min(strange)[:40]!r}, choose from {', '.join(sorted(JSON_KEYS))}")
    if plain.get("version") != VERSION:
        raise MessageError("version", f"version {str(plain.get('version'))[:20]!r}, only {VERSION} is known")
    stream, sequence = _parse_int(plain, "stream", 0), _parse_int(plain, "sequence", None)
    oldest = None if plain.get("oldest") is None else _parse_int(plain, "oldest", None)
    columns = dict(plain)
    if covariates:
        named = plain.get("covariates")
        if not isinstance(named, dict) or not set(covariates) <= set(named):
            raise MessageError("covariates", f"covariates: missing, expected {', '.join(covariates)}")
        columns |= {f"covariates.{name}": named[name] for name in covariates}
        columns = {**dict.fromkeys("ruy", named[covariates[0]]), **columns} if alone else columns
    numbers = np.stack(_parse_columns(columns, ("r", "u", "y", *(f"covariates.{name}" for name in covariates))))
    if "t" in plain:
        (t,) = _parse_columns(plain, ("t",))
    else:
        t = _uniform_times(_parse_number(plain, "t0"), _parse_number(plain, "dt"), numbers.shape[1])
    return _build_block(asset, stream, sequence, oldest, _join_columns(t, numbers), received_at)


def parse_json(message: bytes) -> Any:
    """Return what a JSON text holds; raises ValueError or RecursionError if it is none."""
    import msgspec

    try:
        return msgspec.json.decode(message)
    except msgspec.DecodeError:  # json takes more, NaN for example, and says what is wrong
        return json.loads(message)


def _parse_int(plain: dict[str, Any], name: str, otherwise: int | None) -> int:
    value = plain.get(name, otherwise)
    if not isinstance(value, int) or isinstance(value, bool):
        raise MessageError("wrong type", f"{name}: missing, or no whole number")
    return value


def _parse_number(plain: dict[str, Any], name: str) -> float:
    value = plain.get(name)
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise MessageError("wrong type", f"{name}: missing, or no number; give t, or t0 and dt")
    try:
        return float(value)
    except OverflowError:
        raise MessageError("wrong type", f"{name}: no number that a computer can hold") from None


def _parse_columns(plain: dict[str, Any], names: tuple[str, ...]) -> list[FloatArray]:
    columns = []
    for name in names:
        values = plain.get(name)
        if not isinstance(values, list) or not set(map(type, values)) <= {int, float, type(None)}:
            raise MessageError("wrong type", f"{name}: missing, or no list of numbers and nulls")
        try:
            columns.append(np.array(values, dtype=np.float64))  # None becomes NaN
        except OverflowError:
            raise MessageError("wrong type", f"{name}: holds a number that no computer can hold") from None
    if len({column.size for column in columns}) > 1:
        raise MessageError("lengths", f"{', '.join(f'{x.size} of {n}' for n, x in zip(names, columns, strict=True))}")
    return columns


def _uniform_times(t0: float, dt: float, n: int) -> FloatArray:
    if not (0.0 <= t0 < MAX_TIME_S and 0.0 < dt < MAX_TIME_S):
        raise MessageError("times", f"t0 = {t0:g} and dt = {dt:g} are no clock")
    return t0 + dt * np.arange(n, dtype=np.float64)


def _join_columns(t: FloatArray, numbers: FloatArray) -> FloatArray:
    """Return t, r, u, y and the covariates as rows, shape (4 + k, N)."""
    if t.size != numbers.shape[1]:
        kind = "lengths" if t.size else "empty"
        raise MessageError(kind, f"{t.size} time stamps, {numbers.shape[1]} samples" if t.size else "no samples")
    return np.concatenate([t[None, :], numbers])


def _build_block(
    asset: str, stream: int, sequence: int, oldest: int | None, signals: FloatArray, received_at: float
) -> Block:
    t = signals[0]
    if not t.size:
        raise MessageError("empty", "no samples")
    counts = stream, sequence, oldest or 0
    if min(counts) < 0 or max(counts) > MAX_COUNT:
        name = next(name for name, n in zip(COUNTS, counts, strict=True) if not 0 <= n <= MAX_COUNT)
        raise MessageError("out of range", f"{name}: must lie between 0 and 2^63 - 1")
    if not (t.item(t.argmin()) >= 0.0 and t.item(t.argmax()) < MAX_TIME_S):  # NaN is both, and neither
        raise MessageError("times", "a time stamp is missing, or outside of the years 1970 to 9999")
    return Block.from_signals(asset, sequence, signals, received_at, stream, oldest)


class BlockMessages(Decoder):
    """Decodes the blocks of some assets under the topics that begin with a prefix."""

    def __init__(self, prefix: str, assets: Mapping[str, SourceAsset]) -> None:
        if find_spec("simdjson") is None:
            raise ConfigError("pysimdjson is missing, pip install 'servoscope[mqtt]'")
        self._prefix, self._assets = prefix, dict(assets)

    def addresses(self, *, everyone: bool = False) -> list[str]:
        """Return the topics of these assets: another service at this broker may follow others."""
        return [data_topic(self._prefix, asset) for asset in sorted(self._assets)]

    def find_asset(self, address: str) -> str:
        """Return the asset of a topic; empty: none of ours."""
        asset = parse_asset(address)
        return asset if asset in self._assets else ""

    def decode(self, message: InboxMessage) -> Content:
        """Return the block of one message."""
        asset = parse_asset(message.address)
        if asset not in self._assets:
            raise MessageError("unknown asset", f"{asset[:100]!r} is none of the assets of this source")
        covariates, alone = self._assets[asset].covariates, self._assets[asset].alone
        return Content(blocks=(decode_block(asset, message.content, message.at, covariates, alone=alone),))
