"""What people are shown of an asset: the status beside its checkpoint."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any

from servoscope import quality
from servoscope.alarms import AlarmDefinition, State, status
from servoscope.live.checkpoint import Progress
from servoscope.live.judging import Judged

__all__ = ["status_of", "summary_of"]


def summary_of(judged: Judged, findings: Iterable[str]) -> str:
    """Return what is said of an asset: its last examination, unless data quality overrules that."""
    if quality.judged(judged.verdict, findings) == judged.verdict:
        return judged.summary
    return f"Undetermined: {quality.told(findings)}."


def status_of(progress: Progress, definitions: Mapping[str, AlarmDefinition]) -> dict[str, Any]:
    """Return the status of an asset as plain values.

    Parameters
    ----------
    progress
        Where it stands.
    definitions
        Of its alarms.
    """
    judged, findings = progress.judged, quality.standing(progress.quality)
    verdict = quality.judged(judged.verdict, findings)
    ne107 = status(verdict, findings, [(definitions[name], state) for name, state in progress.alarms.items()])
    return {
        "verdict": verdict,
        "summary": summary_of(judged, findings),
        "since": judged.since,
        "onset": judged.onset,
        "examined": judged.examined,
        "ne107": ne107.ne107,
        "reasons": list(ne107.reasons),
        "quality": findings,
        "alarms": {
            name: {"state": state.state.value, "since": state.since, "priority": definitions[name].priority}
            for name, state in progress.alarms.items()
            if state.state is not State.NORMAL
        },
        **progress.shown,
        "counted": asdict(progress.counted),
    }
