"""Structured logs: one JSON object per line."""

from __future__ import annotations

import json
import logging
import sys
from datetime import UTC, datetime
from typing import TextIO

__all__ = ["log", "set_up"]

LOGGER = logging.getLogger("servoscope")
LIBRARIES = ("psycopg", "asyncua")  # they tell of lost connections on their own


class _Lines(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        said = {
            "at": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "event": record.getMessage(),
            **getattr(record, "fields", {}),
        }
        if record.exc_info:
            said["trace"] = self.formatException(record.exc_info)
        return json.dumps(said, default=str)


def set_up(level: str, stream: TextIO | None = None) -> None:
    """Send the logs of this process to a stream, by default stderr."""
    handler = logging.StreamHandler(stream or sys.stderr)
    handler.setFormatter(_Lines())
    LOGGER.setLevel(level.upper())
    for logger in (LOGGER, *map(logging.getLogger, LIBRARIES)):
        logger.handlers[:] = [handler]
        logger.propagate = False


def log(level: str, event: str, **fields: object) -> None:
    """Log an event with its fields."""
    LOGGER.log(logging.getLevelNamesMapping()[level.upper()], event, extra={"fields": fields})
