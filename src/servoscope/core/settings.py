"""Settings from TOML files: strict types of values, and no unknown keys."""

from __future__ import annotations

import tomllib
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from servoscope.core.errors import ObsoleteSettingWarning, ServoscopeError

Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0.0)]
NonNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0.0)]
NonEmptyStr = Annotated[str, Field(strict=True, min_length=1)]


def _check_not_zero(value: float) -> float:
    if value == 0.0:
        raise ValueError("must not be 0")
    return value


NOT_ZERO = AfterValidator(_check_not_zero)


class Settings(BaseModel):
    """The base of settings: frozen, unknown keys are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid")


def drop_obsolete(table: Any, remedies: Mapping[str, str]) -> Any:
    """Return a table without the keys of earlier versions; a warning says what takes the place of each."""
    if not isinstance(table, Mapping):
        return table
    for key in remedies.keys() & table.keys():
        warnings.warn(remedies[key], ObsoleteSettingWarning, stacklevel=2)
    return {key: value for key, value in table.items() if key not in remedies}


def read_toml_text(path: Path, what: str, error: type[ServoscopeError]) -> str:
    """Return the text of a TOML file; messages call it `what`, and `error` is raised if it cannot be read."""
    if path.is_dir():
        raise error(f"{path}: is a directory, give the {what} in it")
    try:
        return path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        raise error(f"{path}: no such file, check the path of the {what}") from None
    except OSError as cause:
        raise error(f"{path}: cannot be read ({cause.strerror or cause})") from None
    except UnicodeDecodeError:
        raise error(f"{path}: is not a text file, a {what} is TOML in UTF-8") from None


def parse_toml(text: str, name: object, error: type[ServoscopeError]) -> dict[str, Any]:
    """Return the table of a TOML text; messages call it `name`, and `error` is raised if it is not TOML."""
    try:
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as cause:
        raise error(f"{name}: not valid TOML: {' '.join(str(cause).split())}") from None
