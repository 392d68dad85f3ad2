"""Decoders fed with everything: what is no block is refused with the project's own error, and with no other."""

from __future__ import annotations

import json
import struct
import tracemalloc
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servoscope.core.errors import MessageError
from servoscope.service.mqtt import payload, topics
from servoscope.service.sources.block import Block

T0 = 1767225600.0
NUMBERS = st.floats(allow_nan=True, allow_infinity=True)


@st.composite
def blocks(draw: st.DrawFn) -> Block:
    n = draw(st.integers(1, 20))
    signals = np.array(draw(st.lists(NUMBERS, min_size=3 * n, max_size=3 * n))).reshape(3, n)
    t = T0 + 0.01 * np.arange(n)
    if draw(st.booleans()):
        t = np.array(draw(st.lists(st.floats(0.0, payload.MAX_TIME_S, exclude_max=True), min_size=n, max_size=n)))
    whole = st.integers(0, payload.MAX_COUNT)
    return Block("press", draw(whole), t, *signals, stream=draw(whole))


@given(blocks(), st.none() | st.integers(0, payload.MAX_COUNT))
def test_a_block_comes_back_bit_by_bit(block: Block, oldest: int | None) -> None:
    found = payload.decode_block("press", payload.encode_binary(block, oldest))
    assert np.array_equal(found.signals.view(np.int64), block.signals.view(np.int64))
    assert (found.stream, found.sequence, found.retained, found.oldest) == (
        block.stream,
        block.sequence,
        oldest is not None,
        oldest,
    )
    text = payload.decode_block(
        "press", payload.encode_json(block, oldest)
    )  # JSON has no infinity: it is missing as well
    expected = np.where(np.isfinite(block.signals), block.signals, np.nan)
    assert np.array_equal(text.signals, expected, equal_nan=True) and text.oldest == oldest


def taken(message: bytes) -> None:
    """Decode: a block whose times and numbers can be used, or the project's own error with a line that says why."""
    try:
        block = payload.decode_block("press", message)
    except MessageError as error:
        assert error.kind and str(error) and "\n" not in str(error)
        return
    assert block.t.size and ((block.t >= 0.0) & (block.t < payload.MAX_TIME_S)).all()
    assert {x.size for x in (block.r, block.u, block.y)} == {block.t.size}
    assert 0 <= block.sequence < 2**63 and 0 <= block.stream < 2**63


def test_what_it_quotes_keeps_to_one_line() -> None:
    taken(b'{"version": "\\n1"}')
    taken(b'{"\\n": 1}')


@given(st.binary(max_size=300) | st.binary(max_size=300).map(lambda x: b"SVSB\x01" + x))
@settings(max_examples=300)
def test_any_bytes(message: bytes) -> None:
    taken(message)


@given(blocks(), st.data())
@settings(max_examples=300)
def test_a_damaged_block_whose_checksum_fits(block: Block, data: st.DataObject) -> None:
    message = bytearray(payload.encode_binary(block))
    for _ in range(data.draw(st.integers(1, 8))):
        message[data.draw(st.integers(4, len(message) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(message)))
    message = message[:cut] if data.draw(st.booleans()) else message
    if len(message) > 16 and data.draw(st.booleans()):
        message[12:16] = struct.pack("<I", zlib.crc32(message[16:]))
    taken(bytes(message))


JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**400), 10**400) | NUMBERS | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=8,
)
KEY = st.sampled_from(sorted(payload.JSON_KEYS))


@given(st.dictionaries(KEY, JSON), st.dictionaries(KEY, st.just([1.0, 2.0])), st.booleans())
@settings(max_examples=300)
def test_any_json(changed: dict[str, object], more: dict[str, object], version: bool) -> None:
    good = {"version": 1, "sequence": 3, "t": [T0, T0 + 1.0], "r": [0, 1], "u": [0.5, None], "y": [1e300, 2]}
    taken(json.dumps({**good, **more, **changed, **({"version": 1} if version else {})}).encode())


@given(st.binary(max_size=60) | JSON.map(lambda x: json.dumps(x).encode()))
def test_any_acknowledgement(message: bytes) -> None:
    try:
        stream, sequence = topics.decode_ack(message)
    except MessageError:
        return
    assert min(stream, sequence) >= -1


def test_a_damaged_byte_in_a_name_is_told_as_what_it_is() -> None:
    with pytest.raises(MessageError, match="no JSON"):
        payload.decode_block("press", b'{"version": 1, "s\xfatream": 0}')


def test_what_is_announced_takes_no_memory() -> None:
    head = payload.HEADER.pack(payload.MAGIC, 1, 0, 0, 2**32 - 1, 0) + payload.BODY_HEADER.pack(0, 0, 0, T0, 0.01)
    tracemalloc.start()
    with pytest.raises(MessageError, match="56 bytes, 4294967295 samples need 103079215136"):
        payload.decode_block("press", head)
    assert tracemalloc.get_traced_memory()[1] < 100_000
    tracemalloc.stop()


def test_the_binary_form_is_the_documented_one() -> None:
    """Written by hand, as somebody with another language would."""
    body = struct.pack("<QQQdd", 5, 7, 6, T0, 0.5) + struct.pack("<6f", 1, 2, 3, 4, 5, float("nan"))
    message = b"SVSB" + bytes([1, 1 | 4, 0, 0]) + struct.pack("<II", 2, zlib.crc32(body)) + body
    block = payload.decode_block("press", message, 3.0)
    assert (block.stream, block.sequence, block.oldest, block.completed_at) == (5, 7, 6, 3.0)
    assert block.t.tolist() == [T0, T0 + 0.5] and block.r.tolist() == [1.0, 2.0] and block.u.tolist() == [3.0, 4.0]
    assert block.y[0] == 5.0 and np.isnan(block.y[1])


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ('{"version": 2}', "version"),
        ('{"version": 1, "sequnce": 1}', "keys"),
        ('{"version": 1, "sequence": 1.5}', "wrong type"),
        ('{"version": 1, "sequence": true}', "wrong type"),
        ('{"version": 1, "sequence": -1, "t": [0], "r": [0], "u": [0], "y": [0]}', "out of range"),
        ('{"version": 1, "sequence": 1, "t": [0], "r": [0], "u": [0, 1], "y": [0]}', "lengths"),
        ('{"version": 1, "sequence": 1, "t": [0, 1], "r": [0], "u": [0], "y": [0]}', "lengths"),
        ('{"version": 1, "sequence": 1, "t": [NaN], "r": [0], "u": [0], "y": [0]}', "times"),
        ('{"version": 1, "sequence": 1, "t": [1e30], "r": [0], "u": [0], "y": [0]}', "times"),
        ('{"version": 1, "sequence": 1, "t0": 0, "dt": 0, "r": [0], "u": [0], "y": [0]}', "times"),
        ('{"version": 1, "sequence": 1, "t0": 0, "dt": 1, "r": ["0"], "u": [0], "y": [0]}', "wrong type"),
        ('{"version": 1, "sequence": 1, "t0": 0, "dt": 1, "r": [], "u": [], "y": []}', "empty"),
    ],
)
def test_each_case_has_its_name(text: str, kind: str) -> None:
    with pytest.raises(MessageError) as error:
        payload.decode_block("press", text.encode())
    assert error.value.kind == kind
