"""Baselines: those of the service file and those that were saved here; the loops that come with them; learning."""

from __future__ import annotations

from fastapi import APIRouter

from servoscope.web.context import Context

router = APIRouter(tags=["baselines"])


def id_of_asset(context: Context, asset: str) -> str | None:
    """Return the id of the baseline that an asset is compared with, where the service file tells."""
    config = context.config
    return f"service:{asset}" if config is not None and asset in config.assets else None
