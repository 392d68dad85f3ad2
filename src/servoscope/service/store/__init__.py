"""History in SQL: diagnoses, alarms, residuals, audit, checkpoints; SQLite in a file, or PostgreSQL by URL."""

from servoscope.service.store.batch import Batch
from servoscope.service.store.rows import CommandOutcome, Row
from servoscope.service.store.store import Store

__all__ = ["Batch", "CommandOutcome", "Row", "Store"]
