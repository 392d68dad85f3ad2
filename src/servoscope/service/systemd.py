"""What a service tells systemd that has started it: that it is ready, alive, reading its file again, or stopping."""

from __future__ import annotations

import os
import socket
from contextlib import suppress


def notify_systemd(*lines: str) -> None:
    """Send lines such as ``READY=1``, as sd_notify(3) says; without systemd nothing happens."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return
    path = "\0" + address[1:] if address.startswith("@") else address
    # a supervisor that does not listen must not stop the service
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
        sender.setblocking(False)
        sender.sendto("\n".join(lines).encode(), path)
