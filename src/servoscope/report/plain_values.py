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

    from servoscope.baseline.baseline import Baseline
    from servoscope.models.loop import Columns
    from servoscope.signals import Recording
    from servoscope.signals.readers import ChannelInfo
    from servoscope.simulation import Truth


def simulation_summary(recording: Recording, truth: Truth, columns: Columns) -> dict[str, object]:
    """Return what was simulated."""
    named = {fault.parameter: fault.name for fault in truth.plant.all_faults}
    return {
        "samples": recording.samples,
        "duration_s": recording.duration_s,
        "sample_rate_hz": recording.sample_rate,
        "columns": {"t": columns.time or "t", "r": columns.reference, "u": columns.input, "y": columns.output},
        "faults": [{"name": named.get(event.parameter, event.parameter), **asdict(event)} for event in truth.faults],
    }


def channels_summary(name: str, channels: Sequence[ChannelInfo]) -> dict[str, object]:
    """Return the columns of a file, and which of them might be t, r, u and y."""
    from servoscope.signals.readers.axes import signals_of_one_axis
    from servoscope.signals.readers.guess_columns import guess_columns

    listed = [replace_nan({"name": c.name, "type": c.dtype, "min": c.min, "max": c.max}) for c in channels]
    return {"recording": name, "channels": listed, "proposed": guess_columns(signals_of_one_axis(channels))}


def baseline_summary(b: Baseline) -> dict[str, object]:
    """Return what was learned; by operating point where these have names."""
    if b.points:
        return {"loop": b.loop.name, "points": {baseline.point: _point_summary(baseline) for baseline in b.per_point}}
    return _point_summary(b)


def _point_summary(b: Baseline) -> dict[str, object]:
    written = b.model_dump(mode="json", by_alias=True)
    std = [math.sqrt(b.covariance[i][i]) for i in range(len(b.theta))]
    return {
        "loop": b.loop.name,
        "sources": written["sources"],
        "parameters": {name: {"value": value, "std": s} for name, value, s in zip(b.names, b.theta, std, strict=True)},
        "healthy_ratios": written["healthy"]["ratios"],
        "noise": written["healthy"]["noise"],
        "delay_s": b.delay_s,
        "explained": b.detectability.explained,
        "R": b.recursion.R,
        "threshold": b.thresholds.statistic,
        "false_alarms_per_year": b.loop.monitor.false_alarms_per_year,
        "supported_false_alarms_per_year": b.detectability.supported_false_alarms_per_year,
        "model_error": b.loop.monitor.model_error,
        "suggested_model_error": b.detectability.suggested_model_error,
        "promises": written["detectability"]["changes"],
        "learned": [{key: fault[key] for key in ("name", "recordings", "shares")} for fault in written["learned"]],
        "notes": written["notes"],
    }


def to_plain_values(record: BaseModel) -> object:
    """Return a result as plain values; what is not a number becomes None."""
    return json.loads(record.model_dump_json())


def replace_nan(value: Any) -> Any:
    """Return plain values in which what is not a number is None."""
    if isinstance(value, dict):
        return {key: replace_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [replace_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def provenance(baseline: Baseline, file: Path | str, recording: Path | str) -> dict[str, str]:
    """Return where a diagnosis comes from, line by line, for its page."""
    from datetime import UTC, datetime

    from servoscope import __version__

    sources = [source.name for source in baseline.sources]
    surplus = f" and {len(sources) - 5} more" if len(sources) > 6 else ""
    return {
        "recording": str(recording),
        "baseline": f"{file} ({baseline.hash})",
        **({"operating point": baseline.point} if baseline.point else {}),
        "learned from": ", ".join(sources if not surplus else sources[:5]) + surplus,
        "threshold": f"{baseline.thresholds.statistic:.4g}",
        "made with": f"servoscope {__version__}",
        "made at": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
    }
