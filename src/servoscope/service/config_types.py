"""What files of settings have in common here: names, addresses, times, passwords; and how such a file is read."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Annotated, ClassVar, Self
from urllib.parse import urlsplit

from pydantic import AfterValidator, Field, PrivateAttr, ValidationError, model_validator

from servoscope.core.errors import ConfigError
from servoscope.core.settings import NonEmptyStr, Settings, parse_toml, read_toml_text
from servoscope.core.settings_errors import describe_error

Seconds = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=1e-3, le=1e9)]  # what means something as a time


PORT = "0*(?:[0-9]{1,4}|[1-5][0-9]{4}|6[0-4][0-9]{3}|65[0-4][0-9]{2}|655[0-2][0-9]|6553[0-5])"  # up to 65535


def matching(pattern: str, remedy: str) -> AfterValidator:
    """Return the check that all of a text matches a regular expression; `remedy` may name the text as {value!r}."""

    def check(value: str) -> str:
        if not re.fullmatch(pattern, value):
            raise ValueError(remedy.format(value=value))
        return value

    return AfterValidator(check)


def _check_http_url(value: str) -> str:
    try:
        parts = urlsplit(value)
        good = parts.scheme in ("http", "https") and bool(parts.hostname) and (parts.port is None or parts.port > 0)
    except ValueError:
        good = False
    if not good:
        raise ValueError("is no address, write http://... or https://...")  # it may hold a token
    return value


NAME_REMEDY = "{value!r} is no name: letters, digits, _ and later also - . : are allowed, up to 100, no spaces"
ADDRESS_REMEDY = '{value!r} is no address, write "127.0.0.1:9464", or "" for none'
Name = Annotated[str, Field(strict=True), matching(r"\w[\w.:-]{0,99}", NAME_REMEDY)]
Address = Annotated[str, Field(strict=True), matching(f"(?:.+:{PORT})?", ADDRESS_REMEDY)]
HttpUrl = Annotated[str, Field(strict=True, min_length=1), AfterValidator(_check_http_url)]


class SecretSettings(Settings):
    """A table with a secret: that of a signature, of a client, or a password; none: there is none."""

    # secret_env, secret_file: the environment variable or file with it
    secret_env: NonEmptyStr | None = None
    secret_file: NonEmptyStr | None = None

    @property
    def has_secret(self) -> bool:
        """Whether one is named."""
        return self.secret_env is not None or self.secret_file is not None

    @model_validator(mode="after")
    def _check_one_secret(self) -> Self:
        if self.secret_env is not None and self.secret_file is not None:
            raise ValueError("give secret_env or secret_file, not both")
        return self

    def load_secret(self, folder: Path) -> bytes | None:
        """Return the secret, None where there is none; raises ConfigError if it is missing."""
        if self.secret_env is not None:
            value = os.environ.get(self.secret_env, "")
            if not value:
                raise ConfigError(f"the environment variable {self.secret_env} holds no secret, set it")
            return value.encode()
        if self.secret_file is None:
            return None
        path = folder / self.secret_file
        try:
            content = path.read_bytes().strip()
        except OSError as error:
            raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None
        if not content:
            raise ConfigError(f"{path}: holds no secret, write it there")
        return content


def read_password(name: str | None, folder: Path) -> str | None:
    """Return the first line of a password file, or None without one; raises ConfigError if it cannot be read."""
    if name is None:
        return None
    try:
        lines = (folder / name).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", "no text")
        raise ConfigError(f"{folder / name}: the password cannot be read ({reason})") from None
    if not lines or not lines[0]:
        raise ConfigError(f"{folder / name}: its first line must be the password")
    return lines[0]


class FileSettings(Settings):
    """Settings that are a file of their own; `kind_of_file` is what messages call it."""

    kind_of_file: ClassVar[str]
    _file: Path = PrivateAttr(default=Path("settings.toml"))

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a file; raises ConfigError if it cannot be read, is not TOML, or a key in it is wrong."""
        return cls.parse(read_toml_text(Path(path), cls.kind_of_file, ConfigError), Path(path))

    @classmethod
    def parse(cls, text: str, path: Path) -> Self:
        """Return what a text says that is the file of a path, or will be; raises ConfigError as `load` does."""
        try:
            settings = cls.model_validate(parse_toml(text, path, ConfigError))
        except ValidationError as error:
            raise ConfigError(f"{path}: {describe_error(error, cls)}") from None
        settings._file = path.absolute()
        return settings

    @property
    def folder(self) -> Path:
        """What its paths are relative to."""
        return self._file.parent

    @property
    def file(self) -> Path:
        """The file itself."""
        return self._file
