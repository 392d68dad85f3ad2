"""Messages that are read many at once: the same blocks, to the same bits, and the same refusals as one by one."""

from __future__ import annotations

import json
import random
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from servoscope.core.errors import MessageError
from servoscope.service.mqtt import payload
from servoscope.service.mqtt.block_kernels import parse_regular
from servoscope.service.mqtt.payload import BlockMessage, decode_block, decode_blocks, encode_binary, encode_json
from servoscope.service.sources.block import Block

PROJECT = Path(__file__).resolve().parents[2]
T0 = 1767225600.0
HARD = [
    *("9007199254740993", "9007199254740992.5", "9007199254740993.0", "4503599627370497.5", "1e23", "8.5e-3", "0.1e-0"),
    *("9223372036854775807e0", "1.7976931348623157e308", "1.7976931348623158e308", "2.2250738585072014e-308", "5e-324"),
    *(
        "0.00012345678901234567",
        "0.000001234567890123456789",
        "-0.0",
        "-0",
        "-0e5",
        "0e-9999",
        "1E+2",
        "1e-342",
        "1e999",
    ),
    *(
        "123456789012345678",
        "1234567890123456789",
        "12345678901234567890",
        "0.1234567890123456789",
        "7205759403792793.5",
    ),
    *(
        "1.",
        ".5",
        "+1",
        "01",
        "-",
        "1e",
        "1e+",
        "0x1",
        "1_0",
        "--1",
        "1.5.2",
        "NaN",
        "Infinity",
        "null",
        '"1"',
        "[1]",
        "",
    ),
    *(
        "10141204801825835211973625643008e0",
        "3.5844466002796428e298",
        "6.631236846766476e-316",
        "179769313486231580793e289",
    ),
]


def message_of(number: str) -> bytes:
    """Return a message with a number, as text, in each place of y."""
    return f'{{"version":1,"sequence":1,"t":[1,2],"r":[0,0],"u":[0,0],"y":[{number},{number}]}}'.encode()


def outcome(found: object) -> object:
    """Return what a decoder has found, so that it can be compared to the last bit."""
    if isinstance(found, MessageError):
        return found.kind, str(found)
    return found.asset, found.stream, found.sequence, found.oldest, found.signals.tobytes()


def one_by_one(message: bytes) -> object:
    try:
        return outcome(decode_block("press", message))
    except MessageError as error:
        return outcome(error)


def check(messages: list[bytes]) -> None:
    """Check that they are together what each is alone."""
    found = decode_blocks([BlockMessage("press", one) for one in messages])
    assert list(map(outcome, found)) == list(map(one_by_one, messages))


DIGITS = st.text("0123456789", min_size=1, max_size=25)
WRITTEN = st.builds(
    "{}{}{}{}".format,
    st.sampled_from(["", "-"]),
    DIGITS,
    st.just("") | DIGITS.map(".{}".format),
    st.just("") | st.builds("{}{}".format, st.sampled_from(["e", "E", "e-", "e+"]), st.integers(0, 400)),
)


@given(st.floats().map(repr) | st.integers().map(str) | st.floats(-1e6, 1e6).map("{:.3f}".format) | WRITTEN)
@settings(max_examples=500)
def test_a_number_has_the_bits_of_float_or_is_left_to_others(number: str) -> None:
    (found,) = parse_regular([message_of(number)])
    if found is not None:
        assert found.signals[3].tobytes() == np.full(2, float(number)).tobytes()
    check([message_of(number)])


def test_numbers_that_are_hard_to_round_or_to_read() -> None:
    check([message_of(one) for one in HARD])


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False, allow_subnormal=False), min_size=1, max_size=9))
@example([1.1125369292536007e-308, 1e16, 0.0001, -1e-5])
def test_what_json_writes_of_a_number_is_not_left_to_others(values: list[float]) -> None:
    ordinary = [x for x in values if x == 0.0 or 1e-290 < abs(x) < 1e15 or abs(x) >= 1e16]
    block = Block("press", 3, T0 + np.arange(len(ordinary)), *np.array([ordinary] * 3))
    if ordinary:
        (found,) = parse_regular([encode_json(block)])
        assert found is not None and found.signals.tobytes() == block.signals.tobytes()


def signals_of(n: int) -> np.ndarray:
    return np.random.default_rng(n).normal(size=(3, n))


def plain_block(n: int) -> dict[str, object]:
    r, u, y = signals_of(n).tolist()
    return {"version": 1, "stream": 2**60, "sequence": 3, "t": (T0 + np.arange(n)).tolist(), "r": r, "u": u, "y": y}


def single_block(n: int) -> bytes:
    """Return a binary message in single precision, with time stamps."""
    body = struct.pack("<QQQdd", 5, 7, 6, 0.0, 0.0) + (T0 + np.arange(n)).astype("<f8").tobytes()
    body += signals_of(n).astype("<f4").tobytes()
    return b"SVSB" + bytes([1, 1 | 2 | 4, 0, 0]) + struct.pack("<II", n, zlib.crc32(body)) + body


def regular_messages() -> list[bytes]:
    """Return blocks as they are sent: of several lengths, by several senders."""
    found = []
    for n in (1, 2, 7, 100):
        plain = plain_block(n)
        block = Block("press", 3, np.array(plain["t"]), *signals_of(n), stream=2**60)
        uneven = Block("press", 3, block.t + 0.001 * np.arange(n) ** 2, block.r, block.u, block.y)
        gappy = Block("press", 3, block.t, np.where(block.r > 0.0, block.r, np.nan), block.u, np.full(n, np.nan))
        found += [
            encode_json(gappy),
            encode_json(block),
            encode_json(block, 1),
            encode_binary(block),
            encode_binary(uneven, 3),
        ]
        evenly = {key: value for key, value in plain.items() if key != "t"} | {"t0": T0, "dt": 0.01}
        backwards = dict(reversed({**plain, "oldest": 0}.items()))
        found += [json.dumps(one).encode() for one in (plain, evenly, backwards)]
        found += [json.dumps(plain, indent=2).encode() + b"\r\n\t", single_block(n)]
    return found


def test_what_senders_write_is_regular_in_whatever_company() -> None:
    messages = regular_messages()
    assert all(
        (found is None) == (one[:4] == b"SVSB") for one, found in zip(messages, parse_regular(messages), strict=True)
    )
    strange = [
        b"",
        b"{",
        b"SVSB\x01",
        b'{"version":1,"sequence":1,"t":[1',
        message_of("null"),
        message_of("1")[:-1],
        b"\0",
    ]
    chance = random.Random(1)
    for _ in range(20):
        some = chance.choices(messages + strange, k=9)
        check(some)


@given(st.sampled_from(regular_messages()), st.data())
@settings(max_examples=300)
def test_damaged_messages_are_together_what_each_is_alone(message: bytes, data: st.DataObject) -> None:
    damaged = bytearray(message)
    for _ in range(data.draw(st.integers(1, 3))):
        place, own = data.draw(st.integers(0, len(damaged) - 1)), st.sampled_from(b'0123456789.-+eE,:"[]{} \n\0tru')
        damaged[place] = data.draw(own | st.integers(0, 255))
    cut = damaged[: data.draw(st.integers(0, len(damaged)))]
    if message[:4] == b"SVSB" and data.draw(st.booleans()):
        damaged[12:16] = struct.pack("<I", zlib.crc32(damaged[16:]))
    check([message, bytes(damaged), bytes(cut), message])


KEYS = st.sampled_from([*sorted(payload.JSON_KEYS), "x", "sequence2", "\\u0074"])
NUMBERS = "1 0 -1 1.0 01 9223372036854775807 9223372036854775808 99999999999999999999 253402300800 [1,2] [-1,1] [5,5,5]"
OTHERS = "true", "null", '""', "{}", "[]", "[1, 2 ]", "[1,null]", "[1,2,]", "[1,,2]", "[[1],2]"
VALUES = st.sampled_from([*NUMBERS.split(), *OTHERS])


@given(st.lists(st.tuples(KEYS, VALUES), max_size=4), st.integers(0, 5), st.booleans())
@settings(max_examples=300)
def test_any_keys_in_any_order(more: list[tuple[str, str]], place: int, spaced: bool) -> None:
    pairs = [("version", "1"), ("sequence", "4"), ("t", "[5,6]"), ("r", "[1,2]"), ("u", "[1,2]"), ("y", "[1.5,-2e3]")]
    pairs[place:place] = more
    blank = " \n" * spaced
    text = f",{blank}".join(f'"{key}"{blank}:{blank}{value}' for key, value in pairs)
    check([f"{{{blank}{text}{blank}}}".encode()])


@pytest.mark.parametrize(
    ("key", "other"),
    [
        *((b'"sequence"', b'"sequence%s' % end) for end in (b'2"', b'12"', b"12", b"1", b"\0")),
        *((b'"%s"' % key, b'"%s\0"' % key) for key in (b"t", b"y", b"version", b"sequence")),
    ],
)
def test_keys_are_taken_whole(key: bytes, other: bytes) -> None:
    message = message_of("1")
    check([message, message.replace(key, other), message])


def test_covariates_that_an_asset_needs_are_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(payload, "PIECE_BYTES", 1)  # so that there are several pieces
    plain = encode_json(Block("press", 3, np.array([1.0]), *np.ones((3, 1))))
    messages = [BlockMessage("press", plain, 1.5), BlockMessage("press", plain, covariates=("oil",))]
    found, refused = decode_blocks(messages)
    assert not isinstance(found, MessageError) and found.completed_at == 1.5
    assert isinstance(refused, MessageError) and refused.kind == "covariates"
    assert not list(decode_blocks([]))
