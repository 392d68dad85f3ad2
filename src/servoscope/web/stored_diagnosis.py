"""Diagnoses as the store keeps them, read back for a reader: in the language and the time zone of the request."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from servoscope.core.messages import Message, render
from servoscope.diagnosis.result import Diagnosis

# keys of a stored document that are no fields of the diagnosis
STORED_BESIDE = ("began", "signature", "said", "evidence", "arm", "baseline")


def read_diagnosis(document: Mapping[str, Any]) -> Diagnosis | None:
    """Return a stored diagnosis; None where the store has no more of it than the headline."""
    fields = {name: value for name, value in document.items() if name not in STORED_BESIDE}
    return Diagnosis.model_validate(fields) if "recording" in fields else None


def stored_headline(row: Mapping[str, Any]) -> str:
    """Return the headline of a stored diagnosis; its text as it was stored where this version cannot render it."""
    try:
        return render(Message.model_validate(row["document"]["said"]))
    except (KeyError, ValueError, TypeError, AttributeError):
        return str(row["summary"])
