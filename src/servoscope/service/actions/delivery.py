"""One attempt to deliver an entry of the outbox: a signed POST, a program without a shell, an MQTT message, a mail."""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import json
import os
import signal
import ssl
import subprocess
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from servoscope.core.addresses import hide_secrets, show_address
from servoscope.core.errors import ConfigError
from servoscope.service.actions.mail import send_mail
from servoscope.service.actions.outbox import DeliveryAttempt, OutboxEntry, schedule_retry
from servoscope.service.actions.settings import (
    PLACEHOLDERS,
    SINK_NAMES,
    TEST_EVENT,
    ActionSettings,
    CommandSettings,
    EmailSettings,
    MqttMessageSettings,
    Sink,
    WebhookSettings,
)
from servoscope.service.mqtt.client import create_mqtt_client

if TYPE_CHECKING:
    import httpx

MAX_DETAIL_CHARS = 200  # of an answer that are kept


class _DeliveryError(Exception):
    """An attempt failed; its text says why."""

    def __init__(self, reason: str, min_wait_s: float = 0.0) -> None:
        super().__init__(reason)
        self.min_wait_s = min_wait_s


def deliver(row: OutboxEntry, settings: ActionSettings, now: float, folder: Path = Path()) -> DeliveryAttempt:
    """Try once to deliver an entry that is due, now (epoch, s); the paths of sinks are relative to a folder.

    It blocks for up to the sink's `timeout_s`, and raises nothing.
    """
    return deliver_together([row], settings, now, folder)[0]


def deliver_together(
    rows: Sequence[OutboxEntry], settings: ActionSettings, now: float, folder: Path
) -> list[DeliveryAttempt]:
    """Do what `deliver` does for entries of one sink at once; only a mail takes several."""
    name = rows[0].sink
    sink = settings.sinks.get(name)
    try:
        if sink is None:
            raise _DeliveryError(f"none of {SINK_NAMES} is called {name!r} any more")
        outcome, failure = _send(rows, sink, folder), None
    except _DeliveryError as error:
        outcome, failure = _shorten(hide_secrets(str(error))), error
    return [
        DeliveryAttempt(
            row,
            failure is None,
            outcome,
            None
            if failure is None or row.event.get("event") == TEST_EVENT
            else schedule_retry(settings.retry, row, now, failure.min_wait_s),
        )
        for row in rows
    ]


def signature(secret: bytes, timestamp: str, body: bytes) -> str:
    """Return the header ``X-Servoscope-Signature``: HMAC-SHA256 (RFC 2104) of "timestamp.body"."""
    return "sha256=" + hmac.new(secret, timestamp.encode() + b"." + body, hashlib.sha256).hexdigest()


def _send(rows: Sequence[OutboxEntry], sink: Sink, folder: Path) -> str:
    row = rows[0]
    try:
        match sink:
            case WebhookSettings():
                return _post(row, sink, folder)
            case CommandSettings():
                return _run_command(row, sink, folder)
            case MqttMessageSettings():
                return _publish(row, sink, folder)
            case EmailSettings():
                return _mail(rows, sink, folder)
    except ConfigError as error:
        raise _DeliveryError(str(error)) from None


def _mail(rows: Sequence[OutboxEntry], sink: EmailSettings, folder: Path) -> str:
    try:
        secret = sink.load_secret(folder)
        return send_mail(rows[0].key, [row.event for row in rows], sink, secret.decode() if secret else None, folder)
    except (ValueError, OSError, ConfigError) as error:
        raise _DeliveryError(f"{sink.host}: {error}") from None


def _publish(row: OutboxEntry, sink: MqttMessageSettings, folder: Path) -> str:
    host, port = sink.broker.address
    client = create_mqtt_client(sink.broker, folder, "")
    client.connect_timeout = sink.timeout_s
    try:
        client.connect(host, port)
        client.loop_start()
        message = client.publish(sink.topic, json.dumps(row.event, allow_nan=False), qos=1)
        message.wait_for_publish(sink.timeout_s)
        done = message.is_published()
    except (OSError, RuntimeError, ValueError) as error:
        raise _DeliveryError(f"{host}:{port}: {error or type(error).__name__}") from None
    finally:
        client.disconnect()
        client.loop_stop()
    if not done:
        raise _DeliveryError(f"{host}:{port}: not taken within {sink.timeout_s:g} s")
    return "taken by the broker"


def _post(row: OutboxEntry, sink: WebhookSettings, folder: Path) -> str:
    try:
        import httpx
    except ImportError:
        raise _DeliveryError("webhooks need httpx: pip install 'servoscope[service]'") from None
    body = json.dumps(row.event, allow_nan=False).encode()
    headers = {"Content-Type": "application/json", "Idempotency-Key": row.key}
    secret = sink.load_secret(folder)
    if secret is not None:
        # by the clock of the machine, which receivers compare with theirs
        stamp = str(int(time.time()))
        headers |= {"X-Servoscope-Timestamp": stamp, "X-Servoscope-Signature": signature(secret, stamp, body)}
    loop = asyncio.new_event_loop()
    try:
        status, wait = loop.run_until_complete(_request(sink, folder, body, headers))
    except TimeoutError:
        raise _DeliveryError(f"{show_address(sink.url)}: timed out after {sink.timeout_s:g} s") from None
    except (httpx.HTTPError, httpx.InvalidURL, ConfigError, OSError) as error:
        raise _DeliveryError(f"{show_address(sink.url)}: {_root_cause(error)}") from None
    finally:
        loop.close()  # it does not wait for a name server that does not answer
    if not 200 <= status < 300:
        raise _DeliveryError(f"{show_address(sink.url)}: answered {status}", float(wait) if wait.isdecimal() else 0.0)
    return f"answered {status}"


def _root_cause(error: BaseException) -> str:
    """Return what has led to an error, in words: the libraries above the socket say that a connection has failed."""
    while (before := error.__cause__ or error.__context__) is not None:
        error = before
    if isinstance(error, ConnectionError) and error.errno:
        return os.strerror(error.errno)
    return str(error) or type(error).__name__


async def _request(sink: WebhookSettings, folder: Path, body: bytes, headers: Mapping[str, str]) -> tuple[int, str]:
    """Return the status of the answer, and its Retry-After; raises TimeoutError after the sink's `timeout_s`.

    The limits of httpx hold for each read, of which a receiver that drips causes many.
    """
    import httpx

    async with asyncio.timeout(sink.timeout_s):
        target = await asyncio.to_thread(_checked_request, sink, folder)
        # Redirects are not followed: the event goes where the configuration says, or nowhere. The answer's body is
        # not read: it might never end.
        async with (
            httpx.AsyncClient(verify=target.verify, timeout=None, trust_env=target.trust_env) as client,
            client.stream(
                "POST", target.url, content=body, headers={**headers, **target.headers}, extensions=target.extensions
            ) as response,
        ):
            return response.status_code, response.headers.get("Retry-After", "")


class _Target(NamedTuple):
    """Where a webhook's request goes."""

    url: httpx.URL
    headers: dict[str, str]
    extensions: dict[str, str]
    verify: ssl.SSLContext | bool
    trust_env: bool  # whether the proxies of the environment are used


def _checked_request(sink: WebhookSettings, folder: Path) -> _Target:
    """Return where to send a request: with rules for networks to a numeric address, under the name it was found by.

    Raises OSError if there is no such address, or no permitted one.
    """
    import httpx

    url = httpx.URL(sink.url)
    verify = sink.create_tls_context(folder, url.host) if sink.has_certificates else True
    if sink.rules.internal:
        return _Target(url, {}, {}, verify, True)
    address = sink.rules.resolve(url.host, url.port or (443 if url.scheme == "https" else 80))
    name = {"sni_hostname": url.host}  # the certificate is compared with it
    # a proxy would look up the name itself
    return _Target(url.copy_with(host=address), {"Host": url.netloc.decode()}, name, verify, False)


def _run_command(row: OutboxEntry, sink: CommandSettings, folder: Path) -> str:
    argv = [sink.program(folder), *(_fill_placeholder(argument, row) for argument in sink.argv[1:])]
    body = json.dumps(row.event, allow_nan=False).encode()
    with tempfile.TemporaryFile() as errors:
        try:
            process = subprocess.Popen(
                argv,
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=errors,
                start_new_session=True,  # so that what it started itself can be killed with it
            )
        except (OSError, ValueError) as error:
            raise _DeliveryError(f"{argv[0]}: cannot be run ({getattr(error, 'strerror', None) or error})") from None
        try:
            process.communicate(body, timeout=sink.timeout_s)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            raise _DeliveryError(f"{argv[0]}: not done after {sink.timeout_s:g} s, killed") from None
        if process.returncode:
            errors.seek(0)
            text = _shorten(errors.read(4 * MAX_DETAIL_CHARS).decode(errors="replace"))
            raise _DeliveryError(f"{argv[0]}: exit code {process.returncode}" + (f", {text}" if text else ""))
    return "exit code 0"


def _fill_placeholder(argument: str, row: OutboxEntry) -> str:
    name = argument[1:-1]
    return str(row.event.get(name, "")) if argument == f"{{{name}}}" and name in PLACEHOLDERS else argument


def _shorten(text: str) -> str:
    line = " ".join(text.split())
    return line if len(line) <= MAX_DETAIL_CHARS else f"{line[: MAX_DETAIL_CHARS - 3]}..."
