"""Mails about alarms: their text, how they are handed to a server, and how many of them an hour takes."""

from __future__ import annotations

import smtplib
import socket
import threading
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from email.message import EmailMessage
from email.utils import formatdate
from pathlib import Path
from typing import Any

from servoscope.core.messages import message, render
from servoscope.core.texts import clean_texts
from servoscope.service.actions.settings import TEST_EVENT, EmailSettings
from servoscope.service.asset_link import qr_code

HOUR_S = 3600.0
PORTS = {"tls": 465, "starttls": 587, "none": 587}


class HourlyLimit:
    """Counts what is sent within an hour."""

    def __init__(self) -> None:
        self._sent_at = deque[float]()  # by the monotonic clock [s]

    def count(self) -> None:
        """Count one that was sent now."""
        self._sent_at.append(time.monotonic())

    def wait_s(self, per_hour: int) -> float:
        """Return how long the next one has to wait [s]."""
        now = time.monotonic()
        while self._sent_at and self._sent_at[0] <= now - HOUR_S:
            self._sent_at.popleft()
        return self._sent_at[-per_hour] + HOUR_S - now if len(self._sent_at) >= per_hour else 0.0


class _MailServer(smtplib.SMTP):
    """A connection to where the rules for networks allow one, under the name that the certificate must have."""

    def __init__(self, settings: EmailSettings, folder: Path) -> None:
        self._settings = settings
        self._context = settings.create_tls_context(folder, settings.host) if settings.encryption != "none" else None
        self._line: socket.socket | None = None  # what lies below any encryption
        self.is_cut = False
        super().__init__(timeout=settings.timeout_s)

    def _get_socket(self, host: str, port: int, timeout: float) -> socket.socket:
        connection = socket.create_connection((self._settings.rules.resolve(host, port), port), timeout)
        self._line = connection.dup()  # TLS takes the connection over before it shakes hands
        if self.is_cut:
            self.cut()
        if self._settings.encryption == "tls" and self._context is not None:
            return self._context.wrap_socket(connection, server_hostname=host)
        return connection

    def hand_over(self, mail: EmailMessage, password: str | None) -> list[str]:
        """Send a mail, and return to whom the server does not take it; raises OSError, as all errors of smtplib are."""
        self._host = self._settings.host  # what a certificate is compared with
        self.connect(self._settings.host, self._settings.port or PORTS[self._settings.encryption])
        if self._settings.encryption == "starttls":
            self.starttls(context=self._context)
        if self._settings.user is not None and password is not None:
            if not password.isascii():
                raise ValueError("the password has characters beyond ASCII, which SMTP cannot carry")
            self.login(self._settings.user, password)
        refused = self.send_message(mail)
        with suppress(OSError):
            self.quit()
        return sorted(refused)

    def cut(self) -> None:
        """End the connection, from another thread."""
        self.is_cut = True
        if self._line is not None:
            with suppress(OSError):
                self._line.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Close the connection."""
        super().close()
        if self._line is not None:
            self._line.close()


def send_mail(
    key: str, events: Sequence[dict[str, Any]], settings: EmailSettings, password: str | None, folder: Path
) -> str:
    """Send one mail about events, within `timeout_s`, and return what the server has made of it.

    The paths of certificates are relative to a folder.

    Raises OSError or ConfigError if it has not taken the mail.
    """
    mail = compose_mail(key, events, settings)
    server = _MailServer(settings, folder)
    deadline = threading.Timer(settings.timeout_s, server.cut)  # a timeout of a socket starts again with each byte
    deadline.daemon = True
    deadline.start()
    try:
        refused = server.hand_over(mail, password)
    except (OSError, ValueError) as error:
        if server.is_cut or isinstance(error, TimeoutError):
            raise TimeoutError(f"not taken within {settings.timeout_s:g} s") from None
        raise OSError(str(error) or type(error).__name__) from None
    finally:
        deadline.cancel()
        server.close()
    return "taken by the mail server" + (f", but not for {', '.join(refused)}" if refused else "")


def compose_mail(key: str, events: Sequence[dict[str, Any]], settings: EmailSettings) -> EmailMessage:
    """Return a mail about events, in plain text; `key` tells it from others."""
    events = [clean_texts(event) for event in events]
    mail, first = EmailMessage(), events[0]
    subject = _subject(first) if len(events) == 1 else render(message("service.mail.several", count=len(events)))
    mail["From"], mail["To"], mail["Date"] = settings.sender, ", ".join(settings.to), formatdate()
    mail["Subject"] = " ".join(f"[{first.get('service', 'servoscope')}] {subject}".split())
    mail["Message-ID"], mail["Auto-Submitted"] = f"<{key}@servoscope>", "auto-generated"
    mail.set_content("\n\n".join(_describe_event(event) for event in events) + "\n")
    if "link" in first and len(events) == 1:
        code = qr_code(first["link"], "png")
        mail.add_attachment(code, maintype="image", subtype="png", filename="servoscope.png", disposition="inline")
    return mail


def _subject(event: dict[str, Any]) -> str:
    if event.get("event") == TEST_EVENT:
        return str(event["cause"])
    if "asset" not in event:  # of a flood
        return render(message("service.mail.flood", event=event["event"], count=event.get("counted", 0)))
    words = {"asset": event["asset"], "alarm": event["alarm"], "priority": event["priority"]}
    return render(message("service.mail.subject", **words, state=str(event["after"]).replace("_", " ")))


def _describe_event(event: dict[str, Any]) -> str:
    details = event.get("details", {})
    checks = details.get("checks")
    action = render(message("service.mail.checks", checks=checks)) if checks else details.get("operator_action")
    texts = (_subject(event), event.get("cause"), action, details.get("consequence"))
    lines = [str(text) for text in texts if text]
    lines.append(render(message("service.mail.time", t=event["time"])))
    return "\n".join([*lines, *([event["link"]] if "link" in event else [])])
