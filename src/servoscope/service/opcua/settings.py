"""What OPC UA needs at both ends: the library, certificates; and which nodes hold the signals of an asset."""

from __future__ import annotations

from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any, Self

from pydantic import Field, model_validator

from servoscope.core.errors import ConfigError
from servoscope.core.messages import message, render
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

    # an array of Double, written as a whole: number of the block, then N time stamps [UTC s], N of r, of u, of y and of
    # each covariate, in the order of the loop file
    block: NonEmptyStr | None = None
    # r, u, y: numbers, up to 100 Hz; they are resampled to one clock by the time stamps of their source
    r: NonEmptyStr | None = None
    u: NonEmptyStr | None = None
    y: NonEmptyStr | None = None
    covariates: dict[NonEmptyStr, NonEmptyStr] = Field(default_factory=dict)  # numbers too, by name; they may be slower

    @model_validator(mode="after")
    def _check_kind(self) -> Self:
        if (self.block is None) == (None in self.signals) or (self.block is not None and any(self.given[1:])):
            raise ValueError("give block, or r, u and y")
        return self

    @property
    def given(self) -> tuple[str, ...]:
        """All nodes."""
        return tuple(node for node in (self.block, *self.signals, *self.covariates.values()) if node is not None)

    @property
    def signals(self) -> tuple[str | None, ...]:
        """The nodes r, u and y."""
        return self.r, self.u, self.y


def check_nodes(*nodes: str) -> None:
    """Check that these are node ids; raises ConfigError if one is not."""
    from asyncua import ua
    from asyncua.ua.uaerrors import UaError

    for node in nodes:
        try:
            ua.NodeId.from_string(node)
        except UaError:
            raise ConfigError(f"{node!r} is no node id, write for example ns=2;s=press.y") from None


def describe_expiry(client: Any, folder: Path, settings: CertificateSettings, now: datetime) -> str:
    """Return which certificate of a connection has expired, in words; empty: none.

    Neither side has to break off for that, so that samples go on; somebody has to renew it.
    """
    from cryptography import x509

    own = b"" if settings.cert_file is None else (folder / settings.cert_file).read_bytes()  # DER or PEM
    certificates = {"our": own, "server": client.security_policy.peer_certificate}
    words = []
    for whose, raw in certificates.items():
        load = x509.load_pem_x509_certificate if raw and raw.startswith(b"-----") else x509.load_der_x509_certificate
        with suppress(ValueError):  # none, a chain, or a form that cannot be read: the connection was accepted with it
            end = load(raw or b"").not_valid_after_utc
            if end < now:
                words.append(render(message(f"service.trouble.{whose}_certificate", end=f"{end:%Y-%m-%d}")))
    return ", ".join(words)


def import_asyncua() -> Any:
    """Return the library; raises ConfigError if it is missing."""
    try:
        import asyncua
    except ModuleNotFoundError:
        raise ConfigError("asyncua is missing, pip install 'servoscope[opcua]'") from None
    return asyncua


def import_ua() -> Any:
    """Return the library's module of the standard's types; raises ConfigError if it is missing."""
    return import_asyncua().ua


def check_files(folder: Path, *names: str | None) -> None:
    """Check that these files exist; raises ConfigError if one does not."""
    for name in names:
        if name is not None and not (folder / name).is_file():
            raise ConfigError(f"{folder / name}: no such file, give the certificate's path")
