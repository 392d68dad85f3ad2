"""What the settings classes of a service file have in common."""

from __future__ import annotations

import re
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

__all__ = ["Address", "Name", "NotNegative", "Seconds", "Settings", "Word"]

NotNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0.0)]
Seconds = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=1e-3, le=1e9)]  # what means something as a time
Word = Annotated[str, Field(strict=True, min_length=1)]


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


class Settings(BaseModel):
    """Frozen; unknown keys are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid")
