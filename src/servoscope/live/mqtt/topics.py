"""Topics under a common prefix: blocks, their acknowledgements, results; with a version, for later forms."""

from __future__ import annotations

import json
from typing import Annotated

from pydantic import Field

from servoscope.errors import MessageError
from servoscope.live.mqtt.payload import LARGEST

__all__ = ["Prefix", "ack", "ack_of", "asset_of", "data", "status", "to_ack"]

Prefix = Annotated[str, Field(strict=True, pattern=r"^[^#+/\x00]+(/[^#+/\x00]+)*$", max_length=200)]


def data(prefix: str, asset: str) -> str:
    """Return where an asset's blocks are sent; ``+`` for the asset: all of them."""
    return f"{prefix}/v1/data/{asset}"


def ack(prefix: str, asset: str) -> str:
    """Return where is told how far an asset's blocks are safe."""
    return f"{prefix}/v1/ack/{asset}"


def status(prefix: str, asset: str) -> str:
    """Return where an asset's verdict and alarms are told."""
    return f"{prefix}/v1/status/{asset}"


def asset_of(topic: str) -> str:
    """Return the asset of a topic."""
    return topic.rpartition("/")[2]


def to_ack(stream: int, sequence: int) -> bytes:
    """Return the message that blocks up to this one are safe."""
    return json.dumps({"stream": stream, "sequence": sequence}).encode()


def ack_of(message: bytes) -> tuple[int, int]:
    """Return stream and sequence up to which blocks are safe.

    Raises
    ------
    MessageError
        If the message is something else.
    """
    try:
        plain = json.loads(message)
        found = plain["stream"], plain["sequence"]
    except (ValueError, RecursionError, TypeError, KeyError):
        raise MessageError("not an acknowledgement", "no JSON object with stream and sequence") from None
    if any(type(x) is not int or not -1 <= x <= LARGEST for x in found):
        raise MessageError("not an acknowledgement", "stream and sequence must be whole numbers")
    return found
