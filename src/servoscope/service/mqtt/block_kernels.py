"""Regular messages of JSON to blocks, many in one call: the plain form, as `encode_json` writes it.

A message is regular if it has no further columns, each key once, and numbers and nulls in its lists. What is not, or
says anything strange, is left to `payload.decode_block`, which knows all forms and what to say of the others.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from servoscope.core.arrays import FloatArray, IntArray
from servoscope.core.jit import kernel, subroutine
from servoscope.service.mqtt.number_kernels import (
    CLOSING_BYTES,
    Text,
    Word,
    as_float,
    load_word,
    read_number,
    read_whole,
)
from servoscope.service.sources.block import MAX_COUNT, MAX_TIME_S

NAMES = b"version", b"stream", b"sequence", b"oldest", b"t0", b"dt", b"t", b"r", b"u", b"y"
KEYS = np.array([int.from_bytes(name, "little") for name in NAMES], dtype=np.uint64)
VERSION, STREAM, SEQUENCE, OLDEST, T0, DT, T = range(7)
NEEDED = 1 << VERSION | 1 << SEQUENCE | 0b1110 << T
UNIFORM, STAMPED = 1 << T0 | 1 << DT, 1 << T  # which of the keys tell the times
SAMPLES = VERSION  # in the row of a message's whole numbers; the version is always the same
ROW_NUMBERS = 4  # numbers of such a row

COMMA, COLON, QUOTE, OPEN, CLOSE, BEGIN, END = b',:"[]{}'
SPACE, TAB, NEW_LINE, CARRIAGE_RETURN = b" \t\n\r"
NULL, MISSING = Word(int.from_bytes(b"null", "little")), Word(0x7FF8 << 48)  # the bits of NaN
COMMAS, LOW_BITS, ONES = Word(0x2C2C2C2C2C2C2C2C), Word(0x7F7F7F7F7F7F7F7F), Word(0x0101010101010101)
LOW_BYTES = Word(2**32 - 1)


class RegularBlock(NamedTuple):
    """What a regular message holds."""

    stream: int
    sequence: int
    oldest: int | None
    signals: FloatArray  # t, r, u, y, shape (4, N)


def parse_regular(messages: Sequence[bytes]) -> Iterator[RegularBlock | None]:
    """Yield the block of each message, None where it is not regular; their signals are parts of one array."""
    text = np.frombuffer(b"\0".join((*messages, CLOSING_BYTES)), np.uint8)
    starts = np.array([0, *accumulate(len(one) + 1 for one in messages)])
    # one for each comma, but the last of a list, and t where t0 and dt stand for it: memory is for what is there
    most = 4 * int(count_commas(text)) // 3
    whole, numbers = np.empty((len(messages), ROW_NUMBERS), np.int64), np.empty(most)
    parse_messages(text, starts, whole, numbers)
    at = 0
    for n, stream, sequence, oldest in whole.tolist():
        if not n:
            yield None
            continue
        signals, at = numbers[at : at + 4 * n].reshape(4, n), at + 4 * n
        yield RegularBlock(stream, sequence, None if oldest < 0 else oldest, signals)


@kernel
def count_commas(text: Text) -> np.uint64:
    """Return how many commas there are in a text, eight bytes at a time; the last ones are none."""
    count = Word(0)
    for i in range(0, len(text) - 7, 8):
        other = load_word(text, i) ^ COMMAS
        found = ~(((other & LOW_BITS) + LOW_BITS) | other | LOW_BITS)  # the highest bit of each byte that is zero
        count += ((found >> Word(7)) * ONES) >> Word(56)
    return count


@kernel
def parse_messages(text: Text, starts: IntArray, whole: IntArray, numbers: FloatArray) -> None:
    """Read messages into rows of whole numbers and, one block after the other, t, r, u and y.

    `text`: the messages, each with a zero behind it, then `CLOSING_BYTES`; `starts`: of each of them, and of the bytes
    behind them; `whole`: receives samples, stream, sequence and oldest (-1: none), shape (messages, 4); no samples: the
    message is not regular.
    """
    at = 0
    for k in range(len(starts) - 1):
        row, begin, stop = whole[k], starts[k], starts[k + 1] - 1
        row[SAMPLES], row[STREAM], row[OLDEST] = 0, 0, -1
        n = _read_json(text, begin, stop, row, numbers, at)
        if n > 0 and _are_times(numbers, at, n):
            row[SAMPLES] = n
            at += 4 * n


@subroutine
def _are_times(numbers: FloatArray, at: int, n: int) -> bool:
    """Return whether n numbers are times that there can be."""
    wrong = 0
    for j in range(at, at + n):
        wrong += not (0.0 <= numbers[j] < MAX_TIME_S)
    return wrong == 0


@subroutine
def _fill_times(numbers: FloatArray, at: int, n: int, t0: float, dt: float) -> bool:
    """Write the times of n samples that follow each other evenly; return whether they are a clock's."""
    for j in range(n):
        numbers[at + j] = t0 + dt * j
    return 0.0 <= t0 < MAX_TIME_S and 0.0 < dt < MAX_TIME_S


@subroutine
def _skip_space(text: Text, i: int) -> int:
    while text[i] == SPACE or text[i] == NEW_LINE or text[i] == TAB or text[i] == CARRIAGE_RETURN:
        i += 1
    return i


@subroutine
def _read_key(text: Text, i: int) -> tuple[int, int]:
    """Return where the value of the key begins that stands at `i`, and which of `KEYS` it is; -1: none."""
    word, size = load_word(text, i), 1
    while size <= 8 and text[i + size] != QUOTE:
        size += 1
    if size > 8 or text[i + size - 1] == 0:  # zeros behind a shorter key would make it another one
        return -1, 0
    if size < 8:
        word &= (Word(1) << Word(8 * size)) - Word(1)
    for key in range(len(KEYS)):
        if word == KEYS[key]:
            i = _skip_space(text, i + size + 1)
            return (_skip_space(text, i + 1) if text[i] == COLON else -1), key
    return -1, 0


@subroutine
def _read_list(text: Text, i: int, numbers: FloatArray, at: int, most: int) -> tuple[int, int]:
    """Write a list of numbers, at `most` so many; return where it ends, or -1, and how many there are."""
    if text[i] != OPEN:
        return -1, 0
    n, i = 0, _skip_space(text, i + 1)
    while n < most:
        begin = i
        i, value = read_number(text, begin)
        if i < 0:
            if load_word(text, begin) & LOW_BYTES != NULL:
                return -1, n
            i, value = begin + 4, MISSING
        numbers[at + n] = as_float(value)
        n += 1
        if text[i] != COMMA and text[i] != CLOSE:
            i = _skip_space(text, i)
        if text[i] == CLOSE:
            return i + 1, n
        if text[i] != COMMA:
            return -1, n
        i += 1
        if text[i] <= SPACE:
            i = _skip_space(text, i)
    return -1, n


@subroutine
def _read_json(text: Text, begin: int, stop: int, row: IntArray, numbers: FloatArray, at: int) -> int:
    """Return the number of samples of a JSON message, which are written; 0: it is not regular."""
    found, n, t0, dt, i = 0, 0, 0.0, 0.0, _skip_space(text, begin)
    if text[i] != BEGIN or len(numbers) - at < 4:
        return 0
    while text[i] != END:
        i = _skip_space(text, i + 1)
        if text[i] != QUOTE:
            return 0
        i, key = _read_key(text, i + 1)
        if i < 0 or found >> key & 1:
            return 0
        found |= 1 << key
        if key >= T:
            size, place = n, at + (key - T) * n
            if n == 0:  # how many there are, and with it where the columns begin, is known behind the first list
                size, place = (len(numbers) - at) // 4, at
            i, count = _read_list(text, i, numbers, place, size)
            if i < 0 or (count != n and n > 0):
                return 0
            if n == 0 and key > T:
                for j in range(count):
                    numbers[at + (key - T) * count + j] = numbers[at + j]
            n = count
        elif key >= T0:
            i, value = read_number(text, i)
            if i < 0:
                return 0
            if key == T0:
                t0 = as_float(value)
            else:
                dt = as_float(value)
        else:
            i, value = read_whole(text, i)
            if i < 0 or value > Word(MAX_COUNT) or (key == VERSION and value != Word(1)):
                return 0
            if key != VERSION:
                row[key] = np.int64(value)
        i = _skip_space(text, i)
        if text[i] != COMMA and text[i] != END:
            return 0
    times = found & (UNIFORM | STAMPED)
    if _skip_space(text, i + 1) != stop or found & NEEDED != NEEDED or n == 0:
        return 0
    if times == UNIFORM:
        return n if _fill_times(numbers, at, n, t0, dt) else 0
    return n if times == STAMPED else 0
