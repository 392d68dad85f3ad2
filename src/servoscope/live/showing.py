"""What people are shown of an asset: the status beside its checkpoint."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from servoscope import quality
from servoscope.alarms import FAULT, AlarmDefinition, State, status
from servoscope.baseline import Baseline
from servoscope.diagnosis import Trace
from servoscope.live.checkpoint import Progress
from servoscope.live.judging import Judged
from servoscope.live.thinning import gamma

__all__ = ["about", "shown", "status_of", "summary_of"]


def about(baseline: Baseline, group: str, window_s: float) -> dict[str, Any]:
    """Return what is always the same of an asset, and needed to read its numbers: units, rates, names."""
    loop = baseline.loop
    return {
        "group": group,
        "loop": loop.name,
        "plant": loop.plant.kind,
        "baseline": baseline.hash,
        "point": baseline.point or None,
        "sample_rate_hz": loop.sample_rate,
        "units": list(loop.plant.units),  # of y and u
        "coefficient_units": list(loop.plant.coefficient_units),
        "faults": {fault.name: fault.words for fault in loop.plant.faults},
        "window_s": window_s,
    }


def shown(trace: Trace, t: float) -> dict[str, Any]:
    """Return what is shown of a block's evaluations, the last of which was at `t` [UTC s].

    Responses are [frequency in Hz, real and imaginary part, those of the healthy one, and of the first two variance,
    covariance and variance]; parameters [name, value, standard deviation, what a healthy loop would show].
    """
    excess = np.nan_to_num(trace.statistic / trace.threshold)
    H, healthy, C = trace.ifrf.H[-1], trace.ifrf_expected.H[-1], trace.ifrf.covariance[-1]
    parts = (trace.ifrf.frequencies, H.real, H.imag, healthy.real, healthy.imag, C[:, 0, 0], C[:, 0, 1], C[:, 1, 1])
    responses = np.stack(parts, axis=1)
    std = np.sqrt(np.maximum(np.diagonal(trace.covariance[-1]), 0.0))
    parameters = np.stack([trace.theta[-1], std, trace.expected[-1]], axis=1)
    told = bool(trace.ready[-1])
    return {
        "t": t,
        "statistic": float(excess[-1]),
        "level": float(trace.level[-1]),
        "peaks": [float(excess.max()), float(trace.level.max())],  # of the block: what alarms go by
        "residual": gamma(trace, -1),
        "exceeded": bool(trace.exceeded[-1]),
        "responses": [row for row in responses.tolist() if told and np.isfinite(row).all()],
        "parameters": [
            [name, *row]
            for name, row in zip(trace.names, parameters.tolist(), strict=True)
            if told and np.isfinite(row).all()
        ],
    }


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
        "summary": judged.named if verdict == "fault" and judged.named else summary_of(judged, findings),
        "since": judged.since,
        "onset": judged.onset,
        "faults": judged.faults,
        "examined": judged.examined,
        "ne107": ne107.ne107,
        "reasons": list(ne107.reasons),
        "quality": findings,
        "alarms": {
            name: {
                "state": state.state.value,
                "since": state.since,
                "priority": definitions[name].priority,
                # what was said at the last sample would be, once the fault has gone, that all is well
                "cause": judged.named if name == FAULT and judged.named else state.cause,
                "until": state.shelved_until,
            }
            for name, state in progress.alarms.items()
            if state.state is not State.NORMAL
        },
        "awaited": [window.number for window in progress.windows],
        **progress.shown,
        "counted": asdict(progress.counted),
    }
