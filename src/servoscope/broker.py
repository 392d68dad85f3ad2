"""How an MQTT broker is reached: address, password, TLS; clients that come back by themselves."""

from __future__ import annotations

import ssl
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from servoscope.errors import ConfigError
from servoscope.settings import Settings, Word

if TYPE_CHECKING:
    from paho.mqtt.client import Client

__all__ = ["KEEPALIVE_S", "BrokerSettings", "reach"]

PLAIN, SECURE = 1883, 8883
KEEPALIVE_S = 15  # a cable that was pulled is noticed after one and a half of these
LONGEST_WAIT_S = 5  # between two attempts to connect


class BrokerSettings(Settings):
    """Where a broker is, and who we are to it.

    Parameters
    ----------
    host, port
        Its address; the port is 1883 by default, with TLS 8883.
    user, password_file
        Who we are; the password is the first line of a file, relative to the configuration file.
    tls
        Whether the connection is encrypted, and the broker has to prove who it is.
    ca_file
        Certificates that are trusted, instead of those of the system (PEM).
    cert_file, key_file
        Our own certificate, where the broker asks for one (PEM).
    """

    host: Word
    port: Annotated[int, Field(strict=True, ge=1, le=65535)] | None = None
    user: Word | None = None
    password_file: Word | None = None
    tls: Annotated[bool, Field(strict=True)] = False
    ca_file: Word | None = None
    cert_file: Word | None = None
    key_file: Word | None = None

    @property
    def address(self) -> tuple[str, int]:
        """Host and port."""
        return self.host, self.port or (SECURE if self.tls else PLAIN)


def reach(settings: BrokerSettings, folder: Path, client_id: str, *, manual_ack: bool = False) -> Client:
    """Return a client of MQTT 5 that knows where to connect, but has not.

    Parameters
    ----------
    settings
        Of the broker.
    folder
        What its files are relative to.
    client_id
        What the broker calls the session; empty: it makes up a name.
    manual_ack
        Whether messages are acknowledged by ``ack``, not when they come.

    Raises
    ------
    ConfigError
        If a file cannot be used, or paho-mqtt is missing.
    """
    try:
        from paho.mqtt.client import Client, MQTTv5
        from paho.mqtt.enums import CallbackAPIVersion
    except ModuleNotFoundError:
        raise ConfigError("paho-mqtt is missing, pip install 'servoscope[mqtt]'") from None
    client = Client(CallbackAPIVersion.VERSION2, client_id, protocol=MQTTv5, manual_ack=manual_ack)
    client.reconnect_delay_set(1, LONGEST_WAIT_S)
    client.max_inflight_messages_set(1000)  # the broker's own limit, which it tells when we connect, may be lower
    if settings.user is not None:
        client.username_pw_set(settings.user, _password(settings, folder))
    if settings.tls:
        client.tls_set_context(_context(settings, folder))
    elif settings.ca_file or settings.cert_file:
        raise ConfigError(f"{settings.host}: certificates are given, but not tls = true")
    return client


def _password(settings: BrokerSettings, folder: Path) -> str | None:
    if settings.password_file is None:
        return None
    path = folder / settings.password_file
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: the password cannot be read ({getattr(error, 'strerror', 'no text')})") from None
    if not lines or not lines[0]:
        raise ConfigError(f"{path}: its first line must be the password")
    return lines[0]


def _context(settings: BrokerSettings, folder: Path) -> ssl.SSLContext:
    try:
        context = ssl.create_default_context(cafile=str(folder / settings.ca_file) if settings.ca_file else None)
        if settings.cert_file is not None:
            key = folder / settings.key_file if settings.key_file else None
            context.load_cert_chain(folder / settings.cert_file, key)
    except (OSError, ssl.SSLError) as error:
        raise ConfigError(f"{settings.host}: its certificates cannot be used ({error}), give PEM files") from None
    return context
