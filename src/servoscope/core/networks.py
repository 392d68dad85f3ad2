"""Networks by their address and length of prefix, as ``10.0.0.0/8``, and which addresses belong to them."""

from __future__ import annotations

import ipaddress
from collections.abc import Iterable
from typing import Annotated

from pydantic import AfterValidator, Field

IpAddress = ipaddress.IPv4Address | ipaddress.IPv6Address

# IPv6 whose last four bytes are the address of IPv4 that is meant: mapped (RFC 4291), and NAT64 (RFC 6052)
CARRIERS = tuple(map(ipaddress.IPv6Network, ("::ffff:0:0/96", "64:ff9b::/96")))
GLOBAL_UNICAST = ipaddress.IPv6Network("2000::/3")  # all that IANA has assigned to the internet
# What is no host of the internet, though an older Python calls it global: tunnels, which lead to any address of IPv4,
# Teredo (RFC 4380), 6to4 (RFC 3056) and its relays (RFC 3068); and documentation (RFC 9637)
NO_HOSTS = tuple(map(ipaddress.ip_network, ("2001::/32", "2002::/16", "192.88.99.0/24", "3fff::/20")))


def check_network(value: str) -> str:
    """Return a network as it is written; raises ValueError if it is none."""
    try:
        ipaddress.ip_network(value, strict=False)
    except ValueError:
        raise ValueError(f'{value!r} is no network, write "10.0.0.0/8", or one address') from None
    return value


Network = Annotated[str, Field(strict=True), AfterValidator(check_network)]


def parse_ip(host: str) -> IpAddress | None:
    """Return a numeric address; an IPv4 address that IPv6 carries is one of IPv4. None: it is a name."""
    try:
        address = ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return None
    # otherwise ::ffff:10.0.0.1 would pass rules for 10.0.0.0/8
    if any(address in network for network in CARRIERS):
        return ipaddress.IPv4Address(int(address) & 0xFFFFFFFF)
    return address


def is_member(host: str, networks: Iterable[str]) -> bool:
    """Tell whether a numeric address belongs to one of the networks; a name belongs to none."""
    address = parse_ip(host)
    return address is not None and any(address in ipaddress.ip_network(network, strict=False) for network in networks)


def is_internal(host: str) -> bool:
    """Tell whether an address is, or may lead to, another one than a public address of a single host.

    IPv6 is judged by what is known to be public, so that forms which carry IPv4 in other ways (compatible, translated,
    NAT64 of a site, tunnels), site-local addresses and what is not assigned yet are internal without a list of them.
    """
    address = parse_ip(host)
    if address is None or not address.is_global or address.is_multicast:
        return True
    if any(address in network for network in NO_HOSTS):
        return True
    return address.version == 6 and address not in GLOBAL_UNICAST
