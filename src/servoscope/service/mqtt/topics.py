"""Topics under a common prefix: blocks, their acknowledgements, results; with a version, for later forms."""

from __future__ import annotations

import json
from typing import Annotated

from pydantic import Field

from servoscope.core.errors import MessageError
from servoscope.service.sources.block import MAX_COUNT

TopicPrefix = Annotated[str, Field(strict=True, pattern=r"^[^#+/\x00]+(/[^#+/\x00]+)*$", max_length=200)]


def data_topic(prefix: str, asset: str) -> str:
    """Return where an asset's blocks are sent; ``+`` for the asset: those of all."""
    return f"{prefix}/v1/data/{asset}"


def ack_topic(prefix: str, asset: str) -> str:
    """Return where an asset's blocks are acknowledged."""
    return f"{prefix}/v1/ack/{asset}"


def status_topic(prefix: str, asset: str) -> str:
    """Return where an asset's verdict and alarms are published."""
    return f"{prefix}/v1/status/{asset}"


def parse_asset(topic: str) -> str:
    """Return the asset of a topic."""
    return topic.rpartition("/")[2]


def encode_ack(stream: int, sequence: int) -> bytes:
    """Return the message that acknowledges blocks up to this one."""
    return json.dumps({"stream": stream, "sequence": sequence}).encode()


def decode_ack(message: bytes) -> tuple[int, int]:
    """Return stream and sequence of the last block acknowledged; raises MessageError if it is another message."""
    try:
        plain = json.loads(message)
        acknowledged = plain["stream"], plain["sequence"]
    except (ValueError, RecursionError, TypeError, KeyError):
        raise MessageError("not an acknowledgement", "no JSON object with stream and sequence") from None
    if any(type(x) is not int or not -1 <= x <= MAX_COUNT for x in acknowledged):
        raise MessageError("not an acknowledgement", "stream and sequence must be whole numbers")
    return acknowledged
