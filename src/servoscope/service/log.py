"""Structured logs: one JSON object per line."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import TextIO

from servoscope.core.addresses import hide_secrets
from servoscope.core.texts import clean_text

LOGGER = logging.getLogger("servoscope")
MAX_TRACE_CHARS = 20_000
LIBRARIES = ("psycopg", "asyncua")  # they log lost connections themselves


def _to_plain(value: object) -> object:
    """Return a value as JSON takes it: texts are clean, and without the secrets of addresses."""
    if isinstance(value, Mapping):
        return {clean_text(str(key)): _to_plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_to_plain(item) for item in value]
    return value if isinstance(value, bool | int | float | None) else clean_text(hide_secrets(str(value)))


class _JsonFormatter(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        entry = {
            "at": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "event": record.getMessage(),
            **getattr(record, "fields", {}),
        }
        # libraries log addresses as they were given; JSON would escape quotes, so the values are searched first
        plain = {key: _to_plain(value) for key, value in entry.items()}
        if record.exc_info:
            plain["trace"] = clean_text(hide_secrets(self.formatException(record.exc_info)), MAX_TRACE_CHARS)
        return json.dumps(plain, default=str)


def set_level(level: str) -> None:
    """Log what is at least that important: debug, info, warning, error."""
    LOGGER.setLevel(level.upper())


def set_up_logging(level: str, stream: TextIO | None = None) -> None:
    """Send the logs of this process to a stream, by default stderr."""
    handler = logging.StreamHandler(stream or sys.stderr)
    handler.setFormatter(_JsonFormatter())
    set_level(level)
    for logger in (LOGGER, *map(logging.getLogger, LIBRARIES)):
        logger.handlers[:] = [handler]
        logger.propagate = False


def log(level: str, event: str, **fields: object) -> None:
    """Log an event with its fields."""
    LOGGER.log(logging.getLevelNamesMapping()[level.upper()], event, extra={"fields": fields})
