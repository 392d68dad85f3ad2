"""Keeps the server running beside a service, in a process of its own, so that pages hold up no samples."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from servoscope.core.errors import ConfigError
from servoscope.service.process_supervisor import ProcessSupervisor


def supervise_pages(config: Path) -> ProcessSupervisor:
    """Return what starts ``servoscope serve`` for a service file; raises ConfigError if something is not installed."""
    for module in ("fastapi", "uvicorn", "argon2"):
        if find_spec(module) is None:
            raise ConfigError(f"[web]: {module} is missing, pip install 'servoscope[web]'")
    return ProcessSupervisor("pages", lambda: ["serve", str(config), "--with-parent"])
