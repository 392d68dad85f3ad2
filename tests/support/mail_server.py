"""A mail server in a process of its own: `python mail_server.py PORT ENCRYPTION FOLDER`; mails become files there.

A process, because what aiosmtpd imports has the name of a folder of the benchmarks.
"""

from __future__ import annotations

import socket
import ssl
import subprocess
import sys
import time
from email import message_from_bytes, policy
from email.message import EmailMessage
from pathlib import Path
from typing import Any


class MailServer:
    """Such a process; FOLDER has localhost.pem and localhost.key. It knows one user: hall, with the password hush."""

    def __init__(self, folder: Path, encryption: str) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self._folder = folder
        self._process = subprocess.Popen([sys.executable, __file__, str(self.port), encryption, str(folder)])
        deadline = time.monotonic() + 30.0
        while time.monotonic() < deadline:
            try:
                socket.create_connection(("127.0.0.1", self.port), 1.0).close()
                return
            except OSError:
                time.sleep(0.05)
        raise RuntimeError("the mail server does not start")

    @property
    def mails(self) -> list[EmailMessage]:
        """What it has taken, in order."""
        made = [message_from_bytes(path.read_bytes(), policy=policy.default) for path in self._files()]
        return [mail for mail in made if isinstance(mail, EmailMessage)]

    def _files(self) -> list[Path]:
        return sorted(self._folder.glob(f"{self.port}-*.eml"))

    def stop(self) -> None:
        """End it."""
        self._process.terminate()
        self._process.wait()


def serve(port: int, encryption: str, folder: Path) -> None:
    """Take mails until ended."""
    from aiosmtpd.controller import Controller
    from aiosmtpd.smtp import AuthResult

    class Inbox:
        count = 0

        async def handle_DATA(self, _server: Any, _session: Any, envelope: Any) -> str:
            self.count += 1
            part = folder / f"{port}-{self.count:06}.part"
            part.write_bytes(envelope.content)
            part.rename(part.with_suffix(".eml"))
            return "250 OK"

    def check(*words: Any) -> AuthResult:
        known = (words[-1].login, words[-1].password) == (b"hall", b"hush")
        return AuthResult(success=known, handled=known)

    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.load_cert_chain(folder / "localhost.pem", folder / "localhost.key")
    more: dict[str, Any] = {
        "starttls": {"tls_context": context, "require_starttls": True},
        "tls": {"ssl_context": context, "auth_require_tls": False},
        "none": {},
    }[encryption]
    if encryption != "none":
        more |= {"authenticator": check, "auth_required": True}
    controller = Controller(Inbox(), hostname="127.0.0.1", port=port, **more)
    controller.start()
    while True:
        time.sleep(60.0)


if __name__ == "__main__":
    serve(int(sys.argv[1]), sys.argv[2], Path(sys.argv[3]))
