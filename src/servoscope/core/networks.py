"""Networks by their address and length of prefix, as ``10.0.0.0/8``, and which addresses belong to them."""

from __future__ import annotations

import ipaddress
from collections.abc import Iterable
from typing import Annotated

from pydantic import AfterValidator, Field

IpAddress = ipaddress.IPv4Address | ipaddress.IPv6Address


INTERNAL = "internal"  # in place of a network: every address that is not public
NAT64 = ipaddress.ip_network("64:ff9b::/96")  # carries IPv4 addresses in the last four bytes


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
    if isinstance(address, ipaddress.IPv6Address):
        if address in NAT64:
            return ipaddress.IPv4Address(int(address) & 0xFFFFFFFF)
        return address.ipv4_mapped or address
    return address


def is_member(host: str, networks: Iterable[str]) -> bool:
    """Tell whether a numeric address belongs to one of the networks; a name belongs to none."""
    address = parse_ip(host)
    if address is None:
        return False
    return any(_contains(network, address) for network in networks)


def _contains(network: str, address: IpAddress) -> bool:
    if network == INTERNAL:
        return not address.is_global or address.is_multicast
    return address in ipaddress.ip_network(network, strict=False)
