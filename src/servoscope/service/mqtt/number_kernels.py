"""Decimal numbers to binary64, to the bits of ``float``: eight digits at a time, by 128-bit powers of ten.

A number is an integer w of at most 19 digits times a power of ten. Its product with that power, of which 128 bits are
known, has the bits of the result and those that decide how it is rounded (Lemire, 2021, "Number parsing at a gigabyte
per second"; Mushtak and Lemire, 2023, for why 128 bits are enough). Eight digits are added up within a word of 64 bits.

What is no number of JSON, has more digits, or lies outside of the normal numbers of binary64 is left to others: the end
of such a number is -1. `CLOSING_BYTES` have to follow a text.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from servoscope.core.jit import inline

Word = np.uint64
Text = npt.NDArray[np.uint8]
WordArray = npt.NDArray[np.uint64]

ZERO, NINE, MINUS, PLUS, POINT, EXPONENT, LOWER_CASE = 48, 57, 45, 43, 46, 101, 32  # of ASCII
MIN_EXPONENT10, MAX_EXPONENT10 = -342, 308  # powers of ten: beyond, w times them is zero or infinite
MAX_DIGITS = 19  # that a word holds
BYTES = 8  # of a word
CLOSING_BYTES = bytes(16)  # that follow a text: what is read of them is no number

ONE, FIVE_BITS = Word(1), Word(3)
ZEROS, NINES, HIGHS = Word(0x3030303030303030), Word(0x7676767676767676), Word(0x8080808080808080)
TEN, BYTE, TWO_BYTES, FOUR_BYTES = Word(10), Word(8), Word(16), Word(32)
PAIRS, HUNDREDS, UNITS = Word(0x000000FF000000FF), Word(10**2 + (10**6 << 32)), Word(1 + (10**4 << 32))
TENS = np.array([10**k for k in range(MAX_DIGITS + 1)], dtype=np.uint64)
SIGN, TOP, ROUNDING = Word(1 << 63), Word(63), Word(9)
FRACTION, HIDDEN_BIT, CARRY, EXPONENT_PLACE = Word(2**52 - 1), Word(2**52), Word(2**53), Word(52)
LOW_BITS, LAST_BITS = Word(2**9 - 1), Word(3)


@inline
def load_word(data: Any, i: int) -> Any:
    """Return bytes i to i + 7 of an array of bytes as a word, the first of them lowest."""
    word = np.uint64(0)
    for k in range(BYTES):
        word |= np.uint64(data[i + k]) << np.uint64(8 * k)
    return word


@intrinsic
def as_float(typing: Any, word: Any) -> Any:
    """Return the binary64 whose bits a word is."""
    return types.float64(word), lambda context, builder, signature, values: builder.bitcast(
        values[0], context.get_value_type(types.float64)
    )


@intrinsic
def multiply_high(typing: Any, a: Any, b: Any) -> Any:
    """Return the upper 64 bits of the product of two words."""

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        wide = ir.IntType(128)
        product = builder.mul(*(builder.zext(value, wide) for value in values))
        return builder.trunc(builder.lshr(product, wide(64)), ir.IntType(64))

    return types.uint64(types.uint64, types.uint64), code


def _count_zeros(instruction: str) -> Callable[..., Any]:
    def count(typing: Any, word: Any) -> Any:
        return types.uint64(types.uint64), lambda context, builder, signature, values: getattr(builder, instruction)(
            values[0], ir.IntType(1)(0)
        )

    made: Callable[..., Any] = intrinsic(count)
    return made


leading_zeros, trailing_zeros = _count_zeros("ctlz"), _count_zeros("cttz")  # of a word; 64: all its bits


def _powers_of_ten() -> WordArray:
    """Return the first 128 bits of each power, shape (651, 2); those of 10^-27 to 10^-1 are rounded up."""
    rows = []
    for q in range(MIN_EXPONENT10, MAX_EXPONENT10 + 1):
        five = 5 ** abs(q)
        size = five.bit_length()
        bits = (five << 128) >> size if q >= 0 else (1 << (127 + size)) // five + (q >= -27)
        rows.append((bits >> 64, bits & (2**64 - 1)))
    return np.array(rows, dtype=np.uint64)


POWERS = _powers_of_ten()


@inline
def count_digits(word: np.uint64) -> Any:
    """Return how many of eight characters are digits before the first that is none."""
    other = word ^ ZEROS
    return np.int64(trailing_zeros((other | (other + NINES)) & HIGHS) >> FIVE_BITS)


@inline
def sum_digits(digits: np.uint64) -> np.uint64:
    """Return the number that eight digits are, the first of them the lowest byte."""
    x = digits * TEN + (digits >> BYTE)
    return ((x & PAIRS) * HUNDREDS + ((x >> TWO_BYTES) & PAIRS) * UNITS) >> FOUR_BYTES


@inline
def append_digits(w: np.uint64, word: np.uint64, count: int) -> np.uint64:
    """Return w with the first `count` of eight characters behind it, which are digits; 0 <= count < 8."""
    digits = ((word ^ ZEROS) << BYTE) << Word(56 - 8 * count)  # zeros before them; a shift by 64 has no meaning
    return Word(w * TENS[count] + sum_digits(digits))


@inline
def read_whole(text: Text, i: int) -> tuple[int, np.uint64]:
    """Return where the digits end that begin at `i`, and the number that they are."""
    begin, value = i, Word(0)
    word = load_word(text, i)
    count = count_digits(word)
    while count == 8 and i - begin <= BYTES:
        value, i = value * TENS[8] + sum_digits(word ^ ZEROS), i + 8
        word = load_word(text, i)
        count = count_digits(word)
    i += count
    if i == begin or i - begin > MAX_DIGITS or (text[begin] == ZERO and i > begin + 1):
        return -1, value
    return i, append_digits(value, word, count)


@inline
def read_number(text: Text, i: int) -> tuple[int, np.uint64]:
    """Return where the number ends that begins at `i`, and its bits."""
    sign, q, most = Word(0), 0, MAX_DIGITS + 1
    if text[i] == MINUS:
        sign, i = SIGN, i + 1
    begin = i
    if text[i + 1] == POINT and ZERO <= text[i] <= NINE:
        i, w = i + 1, Word(text[i]) - Word(ZERO)
    else:
        i, w = read_whole(text, i)
        if i < 0:
            return -1, w
    if text[i] == POINT:
        i += 1
        point = i
        word = load_word(text, i)
        count = count_digits(word)
        if count == 8:
            w, i = w * TENS[8] + sum_digits(word ^ ZEROS), i + 8
            if w < TENS[8]:  # zeros before the number are no digits of it: at least the one before the point
                most += 4 if w < TENS[5] else 1
            word = load_word(text, i)
            count = count_digits(word)
            if count == 8:
                w, i = w * TENS[8] + sum_digits(word ^ ZEROS), i + 8
                word = load_word(text, i)
                count = count_digits(word)
        i += count
        if i == point or i - begin > most:
            return -1, w
        w, q = append_digits(w, word, count), point - i
    if text[i] | LOWER_CASE == EXPONENT:
        is_negative = text[i + 1] == MINUS
        i += 2 if is_negative or text[i + 1] == PLUS else 1
        word = load_word(text, i)
        count = count_digits(word)
        if count == 0 or count > 4:
            return -1, w
        power: Any = np.int64(append_digits(Word(0), word, count))
        q, i = q - power if is_negative else q + power, i + count
    elif w == Word(0) and q == 0 and sign == SIGN:
        return -1, w  # whether -0 has a sign is not ours to say
    if w == Word(0):
        return i, sign
    if q < MIN_EXPONENT10 or q > MAX_EXPONENT10:
        return -1, w
    bits = round_decimal(w, q)
    return (i if bits != Word(0) else -1), bits | sign


@inline
def round_decimal(w: np.uint64, q: int) -> np.uint64:
    """Return the bits of the number of binary64 that is nearest to w 10^q, w > 0; 0: it is none of the normal ones."""
    shift = leading_zeros(w)
    w <<= shift
    high, low = multiply_high(w, POWERS[q - MIN_EXPONENT10, 0]), w * POWERS[q - MIN_EXPONENT10, 0]
    if high & LOW_BITS == LOW_BITS:  # the next 64 bits of the power may change those that are kept
        more = multiply_high(w, POWERS[q - MIN_EXPONENT10, 1])
        low += more
        if low < more:
            high += ONE
    top = high >> TOP
    place = top + ROUNDING
    m = high >> place
    exponent = ((217706 * q) >> 16) + 1086 + np.int64(top) - np.int64(shift)  # 217706 / 2^16: log2(10)
    if low <= ONE and -4 <= q <= 23 and m & LAST_BITS == ONE and m << place == high:
        m -= ONE  # half-way between two: to the even one
    m = (m + (m & ONE)) >> ONE
    if m == CARRY:
        m, exponent = HIDDEN_BIT, exponent + 1
    if exponent <= 0 or exponent >= 2047:
        return Word(0)
    return Word((m & FRACTION) | (Word(exponent) << EXPONENT_PLACE))
