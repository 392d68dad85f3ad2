"""How an MQTT broker is reached: address, password, TLS; clients that reconnect by themselves."""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from servoscope.core.errors import ConfigError
from servoscope.core.messages import message, render
from servoscope.core.settings import NonEmptyStr
from servoscope.service.config_types import read_password
from servoscope.service.log import log
from servoscope.service.network import TlsSettings

if TYPE_CHECKING:
    from servoscope.service.mqtt.paho_clients import ReceivedMessage


PLAIN_PORT, TLS_PORT = 1883, 8883
KEEPALIVE_S = 15  # a cable that was pulled is noticed after one and a half of these
MAX_RECONNECT_DELAY_S = 5  # between two attempts to connect
SESSION_TAKEN_OVER = 0x8E  # reason code of a broker that has given our session to another client (MQTT 5, 3.14.2.1)
REPEATED_LOSSES, TAKEOVER_S = 3, 60.0  # connections lost within so many seconds: no network does that for long


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

    def checked_address(self) -> tuple[str, int]:
        """Return the address to connect to; raises OSError if there is none that may be reached."""
        host, port = self.address
        return self.rules.resolve(host, port), port


class SessionSettings(BrokerSettings):
    """A broker at which we have a session that it keeps while we are away, and hands to nobody else."""

    # name of the session at the broker; None: one of our own, from the service's name. No two clients may share one.
    client: Annotated[str, Field(strict=True, min_length=1, max_length=200)] | None = None

    def identity(self, name: str) -> str:
        """Return what no other source or outlet may share: the session at this broker."""
        host, port = self.address
        return f"client {self.client or name} at {host}:{port}"


class BrokerConnection:
    """A client and its connection to a broker, which it makes anew when it is lost; `client_id` names its session."""

    def __init__(self, broker: BrokerSettings, client: Any, client_id: str = "") -> None:
        self._broker, self._client, self._client_id = broker, client, client_id
        self._lost_at, self._reason = deque[float](maxlen=REPEATED_LOSSES), ""
        self.connected = False  # whether the broker has accepted us
        client.on_connect = lambda _client, _data, _flags, reason, _properties: self._take_answer(reason)
        client.on_connect_fail = lambda *_: self._take_failure()
        client.on_disconnect = lambda _client, _data, _flags, reason, _properties: self._take_end(reason)

    def connect(self, **options: Any) -> None:
        """Connect, now or as soon as the broker is there."""
        self._client.connect_async(*self._broker.address, keepalive=KEEPALIVE_S, **options)
        self._client.loop_start()

    def close(self) -> None:
        """Disconnect; the broker keeps the session, and what comes for it meanwhile."""
        self.connected = False  # on purpose: its end is no loss
        self._client.disconnect()
        self._client.loop_stop()

    def _on_change(self, accepted: bool) -> None:
        """Do what follows from an answer of the broker, or from the end of a connection; in the client's thread."""

    def _take_answer(self, reason: Any) -> None:
        self.connected = not reason.is_failure
        if self.connected:
            self._reason = ""
            log("info", "broker connected", broker=self._broker.host)
        else:
            self._report(render(message("service.trouble.refused", reason=str(reason))))
        self._on_change(self.connected)

    def _take_failure(self) -> None:
        """Take an attempt that got no answer, whose exception is being handled."""
        self._report(render(message("service.trouble.unreachable", reason=str(sys.exc_info()[1] or "no answer"))))

    def _take_end(self, reason: Any) -> None:
        if self.connected:
            # not every broker says that another client has our name: it shows by our coming back, and being lost again
            taken = reason.value == SESSION_TAKEN_OVER
            self._lost_at.extend([time.monotonic()] * (REPEATED_LOSSES if taken else 1))
            log("warning", "broker lost", broker=self._broker.host, why=str(reason))
            self._reason = render(message("service.trouble.lost", reason=str(reason)))
        self.connected = False
        self._on_change(False)

    def _report(self, trouble: str) -> None:
        if trouble != self._reason:  # the client retries every few seconds; once in the log is enough
            log("error", "broker cannot be reached", broker=self._broker.host, why=trouble)
        self._reason = trouble

    @property
    def trouble(self) -> str:
        """What is wrong, in words; empty: nothing. Who has our name comes back, so that it counts for a while."""
        if len(self._lost_at) == REPEATED_LOSSES and time.monotonic() - self._lost_at[0] < TAKEOVER_S:
            return render(message("service.trouble.takeover", client=self._client_id))
        if self.connected:
            return ""
        return self._reason or render(message("service.trouble.connecting"))


def create_mqtt_client(
    settings: BrokerSettings,
    folder: Path,
    client_id: str,
    on_received: Callable[[ReceivedMessage], None] | None = None,
) -> Any:
    """Return a client of MQTT 5, not yet connected; paths are relative to `folder`.

    With `on_received` it is one for many messages, which are acknowledged when we say so. An empty `client_id` lets the
    broker choose one. Raises ConfigError if a file cannot be used, or paho-mqtt is missing.
    """
    try:
        from servoscope.service.mqtt.paho_clients import BulkClient, CheckedClient
    except ModuleNotFoundError:
        raise ConfigError("paho-mqtt is missing, pip install 'servoscope[mqtt]'") from None
    client = CheckedClient(settings.checked_address, client_id)
    if on_received is not None:
        client = BulkClient(settings.checked_address, client_id, on_received)
    client.reconnect_delay_set(1, MAX_RECONNECT_DELAY_S)
    client.max_inflight_messages_set(1000)  # the broker's own limit, which it states on connecting, may be lower
    if settings.user is not None:
        client.username_pw_set(settings.user, read_password(settings.password_file, folder))
    if settings.tls:
        client.tls_set_context(settings.create_tls_context(folder, settings.host))
    elif settings.has_certificates:
        raise ConfigError(f"{settings.host}: certificates are given, but not tls = true")
    return client
