"""Regular messages of JSON: the same blocks, to the same bits, and the same refusals as by the decoder of all forms."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from servoscope.core.errors import ConfigError, MessageError
from servoscope.service.mqtt import payload
from servoscope.service.mqtt.payload import decode_block, encode_binary, encode_json
from servoscope.service.sources.block import Block

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


def outcome(decode: Callable[..., Block | None], *message: Any) -> object:
    """Return what a decoder finds, so that it can be compared to the last bit; None: it leaves it to others."""
    try:
        found = decode("press", *message)
    except MessageError as error:
        return error.kind, str(error)
    return found and (found.stream, found.sequence, found.oldest, found.signals.tobytes())


def regular(message: bytes) -> object:
    return outcome(payload._decode_regular, message, 1.5)


def check(messages: list[bytes]) -> None:
    """Check that what is regular is what the decoder of all forms makes of it."""
    for message in messages:
        expected = outcome(payload._decode_json, message, 1.5, ())
        assert regular(message) in (None, expected)
        if message[:1] in b"{ \n\r\t":
            assert outcome(decode_block, message, 1.5) == (expected if message else outcome(decode_block, b""))


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
    found = payload._decode_regular("press", message_of(number), 1.5)
    if found is not None:
        assert found.signals[3].tobytes() == np.full(2, float(json.loads(number))).tobytes()
    check([message_of(number)])


def test_numbers_that_are_hard_to_round_or_to_read() -> None:
    check([message_of(one) for one in HARD])


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False, allow_subnormal=False), min_size=1, max_size=9))
@example([1.1125369292536007e-308, 1e16, 0.0001, -1e-5])
def test_what_json_writes_of_a_number_is_not_left_to_others(values: list[float]) -> None:
    ordinary = [x for x in values if x == 0.0 or 1e-290 < abs(x) < 1e15 or abs(x) >= 1e16]
    block = Block("press", 3, T0 + np.arange(len(ordinary)), *np.array([ordinary] * 3))
    if ordinary:
        found = payload._decode_regular("press", encode_json(block), 1.5)
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


def test_what_senders_write_is_regular_unless_values_are_missing() -> None:
    messages = [one for one in regular_messages() if one[:4] != b"SVSB"]
    assert all((regular(one) is None) == (b"null" in one) for one in messages)
    strange = b"", b"{", b'{"version":1,"sequence":1,"t":[1', message_of("null"), message_of("1")[:-1], b"\0"
    check([*messages, *strange])


@given(st.sampled_from(regular_messages()), st.data())
@settings(max_examples=300)
def test_damaged_messages(message: bytes, data: st.DataObject) -> None:
    damaged = bytearray(message)
    for _ in range(data.draw(st.integers(1, 3))):
        place, own = data.draw(st.integers(0, len(damaged) - 1)), st.sampled_from(b'0123456789.-+eE,:"[]{} \n\0tru')
        damaged[place] = data.draw(own | st.integers(0, 255))
    cut = damaged[: data.draw(st.integers(0, len(damaged)))]
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


def test_covariates_that_an_asset_needs_are_asked_for() -> None:
    plain = encode_json(Block("press", 3, np.array([1.0]), *np.ones((3, 1))))
    assert decode_block("press", plain, 1.5).completed_at == 1.5
    with pytest.raises(MessageError, match="expected oil"):
        decode_block("press", plain, covariates=("oil",))


def test_without_the_reader_of_json_nothing_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(payload, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"pysimdjson is missing, pip install 'servoscope\[mqtt\]'"):
        payload.BlockMessages("plant", {})
