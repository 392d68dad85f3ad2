"""Values in several sections of a service file: names, addresses, times."""

from __future__ import annotations

import re
from typing import Annotated

from pydantic import AfterValidator, Field

__all__ = ["Address", "Name", "Seconds"]

Seconds = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=1e-3, le=1e9)]  # what means something as a time


def _is_name(value: str) -> str:
    if not re.fullmatch(r"\w[\w.:-]{0,99}", value):
        raise ValueError(
            f"{value!r} is no name: letters, digits, _ and later also - . : are allowed, up to 100, no spaces"
        )
    return value


def _is_address(value: str) -> str:
    host, _, port = value.rpartition(":")
    if value and not (host and port.isascii() and port.isdecimal() and int(port) <= 65535):
        raise ValueError(f'{value!r} is no address, write "127.0.0.1:9464", or "" for none')
    return value


Name = Annotated[str, Field(strict=True), AfterValidator(_is_name)]
Address = Annotated[str, Field(strict=True), AfterValidator(_is_address)]
