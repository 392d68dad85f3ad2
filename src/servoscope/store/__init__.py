"""History in SQL: diagnoses, alarms, residuals, audit, checkpoints; SQLite in a file, or PostgreSQL by URL."""

from servoscope.store.batch import Batch, Row
from servoscope.store.store import Store

__all__ = ["Batch", "Row", "Store"]
