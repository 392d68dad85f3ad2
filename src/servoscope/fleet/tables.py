"""The results of items as tables: one row each, the same columns whatever engine they come from."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

__all__ = ["KINDS", "row"]

KINDS = {
    **dict.fromkeys(("asset", "day", "status", "error", "verdict", "fault", "parameter"), "string"),
    **dict.fromkeys(("ratio", "low", "high", "probability", "peak"), "double"),
    **dict.fromkeys(("first_us", "last_us", "alarm_us", "samples", "gaps", "missing", "repeats"), "long"),
    **dict.fromkeys(("summary", "result"), "string"),
}


def row(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return a result as one row of `KINDS`; ``result`` is all of it, as JSON."""
    said = entry.get("diagnosis", {})
    fault: Mapping[str, Any] = next(iter(said.get("faults") or ()), {})
    low, high = fault.get("interval", (None, None))
    told = {"low": low, "high": high, "fault": fault.get("name"), "result": json.dumps(entry)}
    told |= {name: fault.get(name) for name in ("parameter", "ratio")}
    told |= {name: said.get(name) for name in ("verdict", "probability", "summary")}
    return {name: told[name] if name in told else entry.get(name) for name in KINDS}
