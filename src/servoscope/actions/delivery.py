"""One try to deliver one row of the outbox: a signed POST, a program run without a shell, a message to a broker."""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import signal
import subprocess
import tempfile
from pathlib import Path

from servoscope.actions.outbox import Delivery, Outgoing, put_off
from servoscope.actions.settings import PLACEHOLDERS, ActionSettings, CommandSettings, MessageSettings, WebhookSettings
from servoscope.broker import reach
from servoscope.errors import ConfigError

__all__ = ["deliver", "secret_of", "signature"]

SHOWN = 200  # characters of an answer that are kept


class _Failed(Exception):
    """A try failed; its text says why."""

    def __init__(self, why: str, wait: float = 0.0) -> None:
        super().__init__(why)
        self.wait = wait


def deliver(row: Outgoing, settings: ActionSettings, now: float) -> Delivery:
    """Try once to deliver a row that is due. It blocks for up to the sink's `timeout_s`, and raises nothing.

    Parameters
    ----------
    row
        What to deliver.
    settings
        Where to.
    now
        Time (epoch, s).
    """
    sink = settings.sinks.get(row.sink)
    wait = 0.0
    try:
        if sink is None:
            raise _Failed(f"no webhook, command or mqtt is called {row.sink!r} any more")
        detail = _sent(row, sink, now)
        return Delivery(row.key, row.sink, now, row.attempts + 1, True, detail)
    except _Failed as failure:
        detail, wait = str(failure), failure.wait
    again = put_off(settings.retry, row, now, wait)
    return Delivery(row.key, row.sink, now, row.attempts + 1, False, _short(detail), again)


def signature(secret: bytes, timestamp: str, body: bytes) -> str:
    """Return what stands in the header ``X-Servoscope-Signature``: HMAC-SHA256 (RFC 2104) of "timestamp.body"."""
    return "sha256=" + hmac.new(secret, timestamp.encode() + b"." + body, hashlib.sha256).hexdigest()


def _sent(row: Outgoing, sink: WebhookSettings | CommandSettings | MessageSettings, now: float) -> str:
    if isinstance(sink, WebhookSettings):
        return _post(row, sink, now)
    return _publish(row, sink) if isinstance(sink, MessageSettings) else _run(row, sink)


def _publish(row: Outgoing, sink: MessageSettings) -> str:
    host, port = sink.broker.address
    try:
        client = reach(sink.broker, Path(), "")
    except ConfigError as error:
        raise _Failed(str(error)) from None
    client.connect_timeout = sink.timeout_s
    try:
        client.connect(host, port)
        client.loop_start()
        told = client.publish(sink.topic, json.dumps(row.event, allow_nan=False), qos=1)
        told.wait_for_publish(sink.timeout_s)
        done = told.is_published()
    except (OSError, RuntimeError, ValueError) as error:
        raise _Failed(f"{host}:{port}: {error or type(error).__name__}") from None
    finally:
        client.disconnect()
        client.loop_stop()
    if not done:
        raise _Failed(f"{host}:{port}: not taken within {sink.timeout_s:g} s")
    return "taken by the broker"


def _post(row: Outgoing, sink: WebhookSettings, now: float) -> str:
    try:
        import httpx
    except ImportError:
        raise _Failed("webhooks need httpx: pip install 'servoscope[service]'") from None
    body = json.dumps(row.event, allow_nan=False).encode()
    headers = {"Content-Type": "application/json", "Idempotency-Key": row.key}
    try:
        secret = secret_of(sink)
    except ValueError as error:
        raise _Failed(str(error)) from None
    if secret is not None:
        stamp = str(int(now))
        headers |= {"X-Servoscope-Timestamp": stamp, "X-Servoscope-Signature": signature(secret, stamp, body)}
    try:
        # Redirects are not followed: the event goes where the configuration says, or nowhere. What is answered, beyond
        # its status, is not read: it might never end.
        with httpx.stream("POST", sink.url, content=body, headers=headers, timeout=sink.timeout_s) as answer:
            status, wait = answer.status_code, answer.headers.get("Retry-After", "")
    except (httpx.HTTPError, httpx.InvalidURL) as error:
        raise _Failed(f"{sink.url}: {error or type(error).__name__}") from None
    if not 200 <= status < 300:
        raise _Failed(f"{sink.url}: answered {status}", float(wait) if wait.isdecimal() else 0.0)
    return f"answered {status}"


def secret_of(sink: WebhookSettings) -> bytes | None:
    """Return the secret that a webhook is signed with; None where it is not signed.

    Raises
    ------
    ValueError
        If it cannot be had; the message says why.
    """
    if sink.secret_env is not None:
        value = os.environ.get(sink.secret_env, "")
        if not value:
            raise ValueError(f"the environment variable {sink.secret_env} holds no secret, set it")
        return value.encode()
    if sink.secret_file is None:
        return None
    try:
        content = Path(sink.secret_file).read_bytes().strip()
    except OSError as error:
        raise ValueError(f"{sink.secret_file}: cannot be read ({error.strerror})") from None
    if not content:
        raise ValueError(f"{sink.secret_file}: holds no secret, write it there")
    return content


def _run(row: Outgoing, sink: CommandSettings) -> str:
    argv = [_filled(argument, row) for argument in sink.argv]
    body = json.dumps(row.event, allow_nan=False).encode()
    with tempfile.TemporaryFile() as complaints:
        try:
            process = subprocess.Popen(
                argv,
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=complaints,
                start_new_session=True,  # so that what it started itself ends with it
            )
        except (OSError, ValueError) as error:
            raise _Failed(f"{argv[0]}: cannot be run ({getattr(error, 'strerror', None) or error})") from None
        try:
            process.communicate(body, timeout=sink.timeout_s)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            raise _Failed(f"{argv[0]}: not done after {sink.timeout_s:g} s, killed") from None
        if process.returncode:
            complaints.seek(0)
            said = _short(complaints.read(4 * SHOWN).decode(errors="replace"))
            raise _Failed(f"{argv[0]}: exit code {process.returncode}" + (f", {said}" if said else ""))
    return "exit code 0"


def _filled(argument: str, row: Outgoing) -> str:
    name = argument[1:-1]
    return str(row.event.get(name, "")) if argument == f"{{{name}}}" and name in PLACEHOLDERS else argument


def _short(text: str) -> str:
    line = " ".join(text.split())
    return line if len(line) <= SHOWN else f"{line[: SHOWN - 3]}..."
