"""Results as plain values, ready for JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pydantic import BaseModel

    from servoscope.baseline import Baseline
    from servoscope.loop import Columns
    from servoscope.readers import ChannelInfo
    from servoscope.recording import Recording
    from servoscope.simulation import Truth

__all__ = ["baseline", "channels", "finite", "plain", "provenance", "simulated"]


def simulated(recording: Recording, truth: Truth, columns: Columns) -> dict[str, object]:
    """Return what was simulated."""
    named = {fault.parameter: fault.name for fault in truth.plant.faults}
    return {
        "samples": recording.samples,
        "duration_s": recording.duration_s,
        "sample_rate_hz": recording.sample_rate,
        "columns": {
            "t": columns.time or "t",
            "r": columns.reference,
            "u": columns.input,
            "y": columns.output,
        },
        "faults": [{"name": named.get(event.parameter, event.parameter), **asdict(event)} for event in truth.faults],
    }


def channels(name: str, found: Sequence[ChannelInfo]) -> dict[str, object]:
    """Return the columns of a file, and which of them might be t, r, u and y."""
    from servoscope.readers.proposing import propose

    told = [
        {
            "name": c.name,
            "type": c.dtype,
            **{key: x if math.isfinite(x) else None for key, x in (("min", c.min), ("max", c.max))},
        }
        for c in found
    ]
    return {"recording": name, "channels": told, "proposed": propose([c.name for c in found])}


def baseline(b: Baseline) -> dict[str, object]:
    """Return what was learned; by operating point where these have names."""
    if b.points:
        return {"loop": b.loop.name, "points": {one.point: _one(one) for one in b.each}}
    return _one(b)


def _one(b: Baseline) -> dict[str, object]:
    said = b.model_dump(mode="json", by_alias=True)
    std = [math.sqrt(b.covariance[i][i]) for i in range(len(b.theta))]
    return {
        "loop": b.loop.name,
        "sources": said["sources"],
        "parameters": {name: {"value": value, "std": s} for name, value, s in zip(b.names, b.theta, std, strict=True)},
        "healthy_ratios": said["ratios"],
        "noise": said["noise"],
        "delay_s": b.delay_s,
        "explained": b.explained,
        "R": b.R,
        "threshold": b.limit,
        "false_alarms_per_year": b.loop.monitor.false_alarms_per_year,
        "supported_false_alarms_per_year": b.supported_false_alarms_per_year,
        "model_error": b.loop.monitor.model_error,
        "suggested_model_error": b.suggested_model_error,
        "promises": said["promises"],
        "learned": [{key: fault[key] for key in ("name", "recordings", "shares")} for fault in said["learned"]],
        "notes": said["notes"],
    }


def plain(said: BaseModel) -> object:
    """Return a result as plain values; what is no number becomes None."""
    return json.loads(said.model_dump_json())


def finite(value: Any) -> Any:
    """Return plain values in which what is no number is None."""
    if isinstance(value, dict):
        return {key: finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def provenance(baseline: Baseline, file: Path, recording: Path) -> dict[str, str]:
    """Return where a diagnosis comes from, line by line, for its report."""
    from datetime import UTC, datetime

    from servoscope import __version__

    sources = [source.name for source in baseline.sources]
    more = f" and {len(sources) - 5} more" if len(sources) > 6 else ""
    return {
        "recording": str(recording),
        "baseline": f"{file} ({baseline.hash})",
        **({"operating point": baseline.point} if baseline.point else {}),
        "learned from": ", ".join(sources if not more else sources[:5]) + more,
        "threshold": f"{baseline.limit:.4g}",
        "made with": f"servoscope {__version__}",
        "made at": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
    }
