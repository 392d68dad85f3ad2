"""The names by which browsers may call the server, and from which pages, so that pages of other sites cannot.

A page of another site can make a browser send requests to any address in its reach, loopback included, and by changing
what its own name resolves to (DNS rebinding) even read the answers. Such a request has the other site's name in Host or
Origin. A numeric address in Host cannot be rebound.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Iterable
from dataclasses import dataclass
from urllib.parse import urlsplit

LOOPBACK = ("localhost", "127.0.0.1", "::1")
DEFAULT_PORTS = {"http": 80, "https": 443}
UNIX = "unix:"  # before the path of a socket


def split_address(address: str) -> tuple[str, int]:
    """Return host and port of ``host:port``; brackets of IPv6 are taken away."""
    host, _, port = address.rpartition(":")
    return host.strip("[]"), int(port)


def is_loopback(host: str) -> bool:
    """Tell whether nobody but this machine reaches a host."""
    address = _parse_ip(host)
    return host == "localhost" or (address is not None and address.is_loopback)


def _parse_ip(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None


@dataclass(frozen=True)
class AllowedHosts:
    """The names of a server."""

    names: frozenset[str]  # that a request may call it by
    numeric: bool  # whether any numeric address will do, where it listens on other interfaces than loopback

    @classmethod
    def of(cls, listen: str, names: Iterable[str]) -> AllowedHosts:
        """Return what a server that listens there is called."""
        host = LOOPBACK[0] if listen.startswith(UNIX) else split_address(listen)[0]
        return cls(frozenset(name.lower() for name in (*LOOPBACK, host, *names)), not is_loopback(host))

    def known(self, host: str) -> bool:
        """Tell whether a Host header is one of the server's own names, whatever the port."""
        name = _parse_origin(f"http://{host}")[1] if host and not set(host) & set("/@?#\\ ") else None
        if name is None:
            return False
        return name in self.names or (self.numeric and _parse_ip(name) is not None)

    @staticmethod
    def same(origin: str, host: str, scheme: str) -> bool:
        """Tell whether a page of this origin was served by the server that the request goes to."""
        theirs = _parse_origin(origin)
        if theirs[0] not in DEFAULT_PORTS:
            return False
        # behind a proxy that ends TLS the server sees http where the page says https: the name and the port must agree
        return any(theirs[1:] == _parse_origin(f"{kind}://{host}")[1:] for kind in {scheme, theirs[0]})


def _parse_origin(url: str) -> tuple[str, str | None, int | None]:
    try:
        split_result = urlsplit(url)
        name = split_result.hostname.rstrip(".") if split_result.hostname else None
        return split_result.scheme, name, split_result.port or DEFAULT_PORTS.get(split_result.scheme)
    except ValueError:
        return "", None, None
