"""How an OPC UA server is reached, and which of its nodes tell the signals of an asset."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from servoscope.errors import ConfigError
from servoscope.live.settings import Seconds
from servoscope.settings import Settings, Word

__all__ = ["Nodes", "OpcuaSettings", "asyncua", "password", "reach"]

SERVER_TIME = "i=2258"  # Server_ServerStatus_CurrentTime, which every server has


class OpcuaSettings(Settings):
    """A source of kind ``opcua``.

    Parameters
    ----------
    url
        Of the server, ``opc.tcp://host:4840``.
    user, password_file
        Who we are; the password is the first line of a file, relative to the service file.
    cert_file, key_file
        Our certificate and its key (DER or PEM). With them messages are signed and encrypted (Basic256Sha256).
    server_cert_file
        The certificate that the server must have; None: what it offers is taken.
    publishing_s
        How often the server sends what has changed [s].
    block
        Length of the blocks that are made of single values [s].
    heartbeat
        Node whose time tells that the server lives: a date, or any value with a time stamp of its source.
    heartbeat_s
        Without a beat for so long, the connection is taken for dead, and made anew [s].
    """

    kind: Literal["opcua"]
    url: Annotated[str, Field(strict=True, pattern=r"^opc\.tcp://[^\s/]+(/.*)?$")]
    user: Word | None = None
    password_file: Word | None = None
    cert_file: Word | None = None
    key_file: Word | None = None
    server_cert_file: Word | None = None
    publishing_s: Seconds = 0.2
    block: Seconds = 1.0
    heartbeat: Word = SERVER_TIME
    heartbeat_s: Seconds = 5.0

    @model_validator(mode="after")
    def _together(self) -> Self:
        if (self.cert_file is None) != (self.key_file is None):
            raise ValueError("cert_file and key_file belong together")
        return self


class Nodes(Settings):
    """The nodes of one asset: either `block`, or `r`, `u` and `y`.

    Parameters
    ----------
    block
        An array of Double, written as a whole: number of the block, then N time stamps [UTC s], N of r, of u and of y.
    r, u, y
        Numbers, up to 100 Hz; they are put on one clock by the time stamps of their source.
    """

    block: Word | None = None
    r: Word | None = None
    u: Word | None = None
    y: Word | None = None

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        singles = [self.r, self.u, self.y]
        if (self.block is None) == (None in singles) or (self.block is not None and any(singles)):
            raise ValueError("give block, or r, u and y")
        return self


def asyncua() -> Any:
    """Return the library.

    Raises
    ------
    ConfigError
        If it is missing.
    """
    try:
        import asyncua as found
    except ModuleNotFoundError:
        raise ConfigError("asyncua is missing, pip install 'servoscope[opcua]'") from None
    return found


def password(settings: OpcuaSettings, folder: Path) -> str | None:
    """Return the password, if there is one.

    Raises
    ------
    ConfigError
        If its file cannot be read.
    """
    if settings.password_file is None:
        return None
    path = folder / settings.password_file
    try:
        return path.read_text(encoding="utf-8").splitlines()[0]
    except (OSError, UnicodeDecodeError, IndexError) as error:
        raise ConfigError(f"{path}: the password cannot be read ({getattr(error, 'strerror', 'no text')})") from None


async def reach(settings: OpcuaSettings, secret: str | None, folder: Path) -> Any:
    """Return a client that knows where to connect, but has not."""
    library = asyncua()
    client = library.Client(settings.url, timeout=settings.heartbeat_s)
    client.name, client.application_uri = "servoscope", "urn:servoscope:client"
    if settings.user is not None:
        client.set_user(settings.user)
        client.set_password(secret or "")
    if settings.cert_file is not None and settings.key_file is not None:
        from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256

        server = folder / settings.server_cert_file if settings.server_cert_file else None
        await client.set_security(
            SecurityPolicyBasic256Sha256,
            str(folder / settings.cert_file),
            str(folder / settings.key_file),
            server_certificate=str(server) if server else None,
        )
    return client
