"""What files of settings have in common: strict values, keys that must be known, and TOML."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from servoscope.errors import ServoscopeError

__all__ = ["Finite", "NotNegative", "Positive", "Settings", "Word", "parsed", "text_of"]

Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0.0)]
NotNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0.0)]
Word = Annotated[str, Field(strict=True, min_length=1)]


class Settings(BaseModel):
    """Frozen; unknown keys are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid")


def text_of(path: Path, what: str, error: type[ServoscopeError]) -> str:
    """Return the text of a TOML file; `what` it is called, and which error is raised if it cannot be read."""
    if path.is_dir():
        raise error(f"{path}: is a directory, give the {what} in it")
    try:
        return path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        raise error(f"{path}: no such file, check the path of the {what}") from None
    except OSError as found:
        raise error(f"{path}: cannot be read ({found.strerror or found})") from None
    except UnicodeDecodeError:
        raise error(f"{path}: is not a text file, a {what} is TOML in UTF-8") from None


def parsed(text: str, name: object, error: type[ServoscopeError]) -> dict[str, Any]:
    """Return what a TOML text says; `name` is what messages call it, and `error` is raised if it is not TOML."""
    try:
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as found:
        raise error(f"{name}: not valid TOML: {' '.join(str(found).split())}") from None
