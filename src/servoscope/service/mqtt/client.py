"""How an MQTT broker is reached: address, password, TLS; clients that reconnect by themselves."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from servoscope.core.errors import ConfigError
from servoscope.core.settings import NonEmptyStr
from servoscope.service.config_types import read_password
from servoscope.service.network import TlsSettings

if TYPE_CHECKING:
    from paho.mqtt.client import Client


PLAIN_PORT, TLS_PORT = 1883, 8883
KEEPALIVE_S = 15  # a cable that was pulled is noticed after one and a half of these
MAX_RECONNECT_DELAY_S = 5  # between two attempts to connect


class BrokerSettings(TlsSettings):
    """Where a broker is, and who we are to it."""

    host: NonEmptyStr  # host, port: its address; the port is 1883 by default, with TLS 8883
    port: Annotated[int, Field(strict=True, ge=1, le=65535)] | None = None
    # user, password_file: who we are; the password is the first line of a file, relative to the configuration file
    user: NonEmptyStr | None = None
    password_file: NonEmptyStr | None = None
    tls: Annotated[bool, Field(strict=True)] = False  # encrypts the connection; the broker has to prove its identity

    @property
    def address(self) -> tuple[str, int]:
        """Host and port."""
        return self.host, self.port or (TLS_PORT if self.tls else PLAIN_PORT)


def create_mqtt_client(settings: BrokerSettings, folder: Path, client_id: str, *, manual_ack: bool = False) -> Client:
    """Return a client of MQTT 5, not yet connected; paths are relative to `folder`.

    An empty `client_id` lets the broker choose one. With `manual_ack` messages are acknowledged by ``ack``, not when
    they come. Raises ConfigError if a file cannot be used, or paho-mqtt is missing.
    """
    try:
        from paho.mqtt.client import Client, MQTTv5
        from paho.mqtt.enums import CallbackAPIVersion
    except ModuleNotFoundError:
        raise ConfigError("paho-mqtt is missing, pip install 'servoscope[mqtt]'") from None

    class CheckedMqttClient(Client):
        """Connects to an address that was checked, and not to a name that may mean another one by then."""

        def _create_socket_connection(self) -> socket.socket:
            host, port = settings.address
            return socket.create_connection((settings.rules.resolve(host, port), port), self.connect_timeout)

    client = CheckedMqttClient(CallbackAPIVersion.VERSION2, client_id, protocol=MQTTv5, manual_ack=manual_ack)
    client.reconnect_delay_set(1, MAX_RECONNECT_DELAY_S)
    client.max_inflight_messages_set(1000)  # the broker's own limit, which it states on connecting, may be lower
    if settings.user is not None:
        client.username_pw_set(settings.user, read_password(settings.password_file, folder))
    if settings.tls:
        client.tls_set_context(settings.create_tls_context(folder, settings.host))
    elif settings.has_certificates:
        raise ConfigError(f"{settings.host}: certificates are given, but not tls = true")
    return client
