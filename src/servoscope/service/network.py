"""Whom the service connects to: the rule for internal addresses, and the certificates of encrypted connections."""

from __future__ import annotations

import socket
import ssl
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar

from pydantic import Field, model_validator

from servoscope.core.errors import ConfigError
from servoscope.core.networks import Network, is_internal, is_member
from servoscope.core.settings import NonEmptyStr, Settings, drop_obsolete

OBSOLETE = {
    "refused": "[network] refused: is no setting any more, write internal = false, which keeps connections from all "
    "internal addresses but those in allowed; a firewall keeps them from public ones"
}


class NetworkSettings(Settings):
    """The section `[network]`: which addresses webhooks, brokers and servers may have."""

    internal: Annotated[bool, Field(strict=True)] = True  # whether addresses may be reached that are not public
    allowed: tuple[Network, ...] = ()  # networks and addresses that may be reached nevertheless

    @model_validator(mode="before")
    @classmethod
    def _read_refused(cls, data: Any) -> Any:
        if isinstance(data, Mapping) and data.get("refused"):
            data = {"internal": False, **data}
        return drop_obsolete(data, OBSOLETE)

    @model_validator(mode="after")
    def _check_consistency(self) -> Self:
        if self.allowed and self.internal:
            raise ValueError("allowed: names exceptions of internal = false, add it")
        return self

    def resolve(self, host: str, port: int) -> str:
        """Return the address to connect to; with rules a numeric one, so that a name cannot change meanwhile.

        Raises OSError if there is none, or none that may be reached.
        """
        if self.internal:
            return host
        resolved = [str(entry[4][0]) for entry in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)]
        permitted = (address for address in resolved if is_member(address, self.allowed) or not is_internal(address))
        address = next(permitted, None)
        if address is None:
            raise PermissionError(f"{resolved[0]} is an internal address, which [network] refuses")
        return address


class ConnectionSettings(Settings):
    """A section that names somebody to connect to."""

    network: NetworkSettings | None = None  # as in ``[network]``, for this one alone; None: as there

    @property
    def rules(self) -> NetworkSettings:
        """The rules that hold."""
        return self.network if self.network is not None else NetworkSettings()


class TlsSettings(ConnectionSettings):
    """Such a section whose connection may be encrypted; files are relative to the file of settings."""

    ca_file: NonEmptyStr | None = None  # certificates that are trusted, instead of those of the system (PEM)
    # cert_file, key_file: our own certificate, where the other side requires one (PEM)
    cert_file: NonEmptyStr | None = None
    key_file: NonEmptyStr | None = None

    @property
    def has_certificates(self) -> bool:
        """Whether a certificate is given."""
        return self.ca_file is not None or self.cert_file is not None

    def create_tls_context(self, folder: Path, host: str) -> ssl.SSLContext:
        """Return a context that verifies the other side; raises ConfigError if a file cannot be used."""
        try:
            context = ssl.create_default_context(cafile=str(folder / self.ca_file) if self.ca_file else None)
            if self.cert_file is not None:
                key = folder / self.key_file if self.key_file else None
                context.load_cert_chain(folder / self.cert_file, key)
        except (OSError, ssl.SSLError) as error:
            raise ConfigError(f"{host}: its certificates cannot be used ({error}), give PEM files") from None
        return context


T = TypeVar("T", bound=Settings)


def apply_network(tables: Mapping[str, T], network: NetworkSettings) -> dict[str, T]:
    """Return tables in which those that connect to somebody have rules."""

    def apply(settings: T) -> T:
        is_open = isinstance(settings, ConnectionSettings) and settings.network is None
        return settings.model_copy(update={"network": network}) if is_open else settings

    return {name: apply(table) for name, table in tables.items()}
