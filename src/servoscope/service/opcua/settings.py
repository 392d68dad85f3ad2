"""What OPC UA needs at both ends: the library, certificates; and which nodes hold the signals of an asset."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Self

from pydantic import model_validator

from servoscope.core.errors import ConfigError
from servoscope.core.settings import NonEmptyStr, Settings


class CertificateSettings(Settings):
    """Our own certificate and its key (DER or PEM); with them messages are signed and encrypted (Basic256Sha256)."""

    cert_file: NonEmptyStr | None = None
    key_file: NonEmptyStr | None = None

    @model_validator(mode="after")
    def _check_certificate(self) -> Self:
        if (self.cert_file is None) != (self.key_file is None):
            raise ValueError("cert_file and key_file belong together")
        return self

    def certificate(self, folder: Path) -> tuple[str, str] | None:
        """Return the paths of certificate and key, if there is one."""
        if self.cert_file is None or self.key_file is None:
            return None
        return str(folder / self.cert_file), str(folder / self.key_file)


class OpcuaNodes(Settings):
    """The nodes of one asset: either `block`, or `r`, `u` and `y`."""

    # an array of Double, written as a whole: number of the block, then N time stamps [UTC s], N of r, of u and of y
    block: NonEmptyStr | None = None
    # r, u, y: numbers, up to 100 Hz; they are resampled to one clock by the time stamps of their source
    r: NonEmptyStr | None = None
    u: NonEmptyStr | None = None
    y: NonEmptyStr | None = None

    @model_validator(mode="after")
    def _check_kind(self) -> Self:
        if (self.block is None) == (None in self.signals) or (self.block is not None and any(self.signals)):
            raise ValueError("give block, or r, u and y")
        return self

    @property
    def signals(self) -> tuple[str | None, ...]:
        """The nodes r, u and y."""
        return self.r, self.u, self.y


def import_asyncua() -> Any:
    """Return the library; raises ConfigError if it is missing."""
    try:
        import asyncua
    except ModuleNotFoundError:
        raise ConfigError("asyncua is missing, pip install 'servoscope[opcua]'") from None
    return asyncua


def check_files(folder: Path, *names: str | None) -> None:
    """Check that these files exist; raises ConfigError if one does not."""
    for name in names:
        if name is not None and not (folder / name).is_file():
            raise ConfigError(f"{folder / name}: no such file, give the certificate's path")
