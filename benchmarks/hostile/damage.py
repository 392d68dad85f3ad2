"""Ways to break what was whole: one function per way, each with a chance of its own and a name for the table."""

from __future__ import annotations

import random
import re
import struct
import zlib
from collections.abc import Callable, Mapping

__all__ = ["WAYS", "damaged", "refitted"]

NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
ABSURD = (
    b"1e308", b"-1e308", b"1e999", b"5e-324", b"-0.0", b"9" * 400, b"-1", b"0", b"18446744073709551616", b"1e-400",
)  # fmt: skip
WRONG = (
    b"null",
    b"true",
    b'"x"',
    b"[]",
    b"{}",
    b"[[[[1]]]]",
    b"",
    b"1,5",
    b"0x1F",
    b"\xff\xfe",
    b"\x00",
    b"2026-13-45",
)
FLOOD = (b"NaN", b"nan", b"Infinity", b"-inf")


def truncated(good: bytes, chance: random.Random) -> bytes:
    """Cut off behind any byte."""
    return good[: chance.randrange(len(good))]


def oversized(good: bytes, chance: random.Random) -> bytes:
    """Append something, or all of it again."""
    return good + (good if chance.random() < 0.5 else chance.randbytes(chance.randrange(1, 5000)))


def flipped(good: bytes, chance: random.Random) -> bytes:
    """Turn some bits; in the head, where lengths and types are, as often as anywhere."""
    data = bytearray(good)
    for _ in range(chance.choice((1, 1, 2, 8, 64))):
        at = chance.randrange(min(len(data), 256) if chance.random() < 0.5 else len(data))
        data[at] ^= 1 << chance.randrange(8)
    return bytes(data)


def overwritten(good: bytes, chance: random.Random) -> bytes:
    """Make a stretch all ones, all zeros, or noise."""
    begin, length = chance.randrange(len(good)), chance.choice((1, 2, 4, 8, 64, 1000))
    fill = chance.choice((bytes(length), b"\xff" * length, b"\x7f" * length, chance.randbytes(length)))
    return (good[:begin] + fill + good[begin + length :])[: len(good)]


def missing(good: bytes, chance: random.Random) -> bytes:
    """Leave out a stretch."""
    begin = chance.randrange(len(good))
    return good[:begin] + good[begin + chance.choice((1, 8, 100, 4096)) :]


def repeated(good: bytes, chance: random.Random) -> bytes:
    """Say a stretch twice."""
    begin = chance.randrange(len(good))
    end = begin + chance.choice((1, 8, 100, 4096))
    return good[:end] + good[begin:end] + good[end:]


def shuffled(good: bytes, chance: random.Random) -> bytes:
    """Exchange two neighbouring stretches."""
    length = chance.choice((1, 8, 100, 1000))
    begin = chance.randrange(len(good))
    middle, end = begin + length, begin + 2 * length
    return good[:begin] + good[middle:end] + good[begin:middle] + good[end:]


def _replaced(good: bytes, chance: random.Random, words: tuple[bytes, ...], most: int) -> bytes:
    found = list(NUMBER.finditer(good[:20_000]))
    if not found:
        return flipped(good, chance)
    data, chosen = good, sorted(chance.sample(range(len(found)), min(len(found), most)), reverse=True)
    for k in chosen:  # from the back, so that places stay where they are
        begin, end = found[k].span()
        data = data[:begin] + chance.choice(words) + data[end:]
    return data


def wrong(good: bytes, chance: random.Random) -> bytes:
    """Put something else where a number was."""
    return _replaced(good, chance, WRONG, chance.choice((1, 2, 20)))


def absurd(good: bytes, chance: random.Random) -> bytes:
    """Put numbers that no sensor gives; in binary, eight bytes of one."""
    if chance.random() < 0.5:
        return _replaced(good, chance, ABSURD, chance.choice((1, 3, 50)))
    begin = 8 * chance.randrange(max(1, len(good) // 8))
    number = struct.pack("<d", chance.choice((1.8e308, -1.8e308, 5e-324, 1e300, 2.0**63, -1.0)) if begin else 0.0)
    return (good[:begin] + number + good[begin + 8 :])[: len(good)]


def flood(good: bytes, chance: random.Random) -> bytes:
    """Put no number, over and over."""
    if chance.random() < 0.5:
        return _replaced(good, chance, FLOOD, chance.choice((1, 50, 1000)))
    begin = 8 * chance.randrange(max(1, len(good) // 8))
    length = 8 * chance.choice((1, 10, 200))
    return (good[:begin] + struct.pack("<d", float("nan")) * (length // 8) + good[begin + length :])[: len(good)]


def noise(good: bytes, chance: random.Random) -> bytes:
    """Leave nothing but its first bytes, if anything."""
    return good[: chance.choice((0, 4, 8, 64))] + chance.randbytes(chance.randrange(len(good)))


WAYS: Mapping[str, Callable[[bytes, random.Random], bytes]] = {
    way.__name__: way
    for way in (
        truncated, oversized, flipped, overwritten, missing, repeated, shuffled, wrong, absurd, flood, noise,
    )
}  # fmt: skip


def damaged(good: bytes, chance: random.Random, number: int) -> bytes:
    """Return input number so and so: the ways take turns, and one time in four a second one comes on top."""
    names = list(WAYS)
    data = WAYS[names[number % len(names)]](good, chance)
    if chance.random() < 0.25 and data:
        data = WAYS[chance.choice(names)](data, chance)
    return data


def refitted(message: bytes, chance: random.Random) -> bytes:
    """Return a binary block with a checksum that fits, half of the times: past it nothing else would be tried."""
    if len(message) <= 16 or chance.random() < 0.5:
        return message
    return message[:12] + struct.pack("<I", zlib.crc32(message[16:])) + message[16:]
