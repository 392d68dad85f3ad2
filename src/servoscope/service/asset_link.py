"""Where an asset's page is, as a link, and as a QR code for a phone."""

from __future__ import annotations

import io
from typing import Literal
from urllib.parse import quote

import segno


def page_address(address: str, asset: str | None) -> str:
    """Return the address of an asset's page, None: of the fleet, on a server at `address`."""
    return address.rstrip("/") + (f"/assets/{quote(asset, safe='')}" if asset is not None else "/")


def qr_code(link: str, kind: Literal["svg", "png"]) -> bytes:
    """Return a picture of the QR code of a link (ISO/IEC 18004)."""
    picture = io.BytesIO()
    segno.make(link, micro=False).save(picture, kind=kind, scale=4)
    return picture.getvalue()
