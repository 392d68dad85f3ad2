"""The last minutes as a recording: examined while the samples go on, diagnosed in full behind their back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from servoscope.baseline import Baseline
from servoscope.diagnosis import Verdict
from servoscope.errors import ServoscopeError
from servoscope.live.block import Block
from servoscope.recording import Recording, clean
from servoscope.store.history import dated

__all__ = ["Examined", "Told", "begun_at", "diagnose_in_full", "examine"]


class Told(NamedTuple):
    """What the store keeps of a diagnosis: verdict, summary, onset [UTC s] or None, and all of it as plain values."""

    verdict: str
    summary: str
    onset: float | None
    document: dict[str, Any]


@dataclass(frozen=True)
class Examined:
    """What an examination of the last minutes says.

    Parameters
    ----------
    verdict
        Of this moment, the end of the window.
    summary
        In a sentence.
    onset
        Since when, about [UTC s]; None unless there is a fault.
    recovering
        Whether there was an alarm in the window that has gone: the window says nothing before that has left it.
    document
        The diagnosis as in ``diagnose --json``; empty unless the window was healthy or undetermined throughout.
    """

    verdict: Verdict
    summary: str
    onset: float | None = None
    recovering: bool = False
    document: dict[str, Any] | None = None


def recording_of(baseline: Baseline, name: str, blocks: Sequence[Block]) -> tuple[Recording, float]:
    """Return blocks as a recording, whose time begins at 0, and the time of its beginning [UTC s].

    Raises
    ------
    RecordingError
        If they cannot be used as one.
    """
    t, r, u, y = np.concatenate([block.signals for block in blocks], axis=1)
    loop, begins = baseline.loop, float(t[np.isfinite(t)][0]) if np.isfinite(t).any() else 0.0
    return clean(t - begins, r, u, y, name=name, sample_rate=loop.sample_rate, limits=loop.input_limits), begins


def examine(baseline: Baseline, name: str, blocks: Sequence[Block]) -> Examined:
    """Examine the last minutes with the reference that ran in them; milliseconds, for nothing is refitted.

    Where the samples cannot be used, the verdict is ``undetermined`` and the summary says why.
    """
    from servoscope.examination import Examination
    from servoscope.verdict import judge

    try:
        recording, begins = recording_of(baseline, name, blocks)
        x = Examination.of(baseline, recording)
    except ServoscopeError as error:
        return Examined("undetermined", f"Undetermined: {error}.")
    alarms = np.flatnonzero(x.alarm)
    if not alarms.size:
        said, _ = judge(x)
        return Examined(said.verdict, said.summary, document=said.model_dump(mode="json"))
    if not x.alarm[-1]:
        return Examined(
            "undetermined", "Undetermined: a deviation has gone, and is still in the window.", recovering=True
        )
    first = 0 if x.alarm.all() else len(x.alarm) - int(np.argmin(x.alarm[::-1]))
    crossed = int(x.estimates.crossed[first]) - 1
    onset = begins + float(recording.t[crossed if crossed >= 0 else int(x.estimates.index[first])])
    excess = float((x.statistic / baseline.limit)[first:].max())
    level = float(x.estimates.level[first:].max())
    tests = f"T^2 is {excess:.3g} times its limit"
    if baseline.members:
        tests += f", the sequential test {level:.3g} times"
    return Examined("fault", f"Fault: {tests}; the full diagnosis follows.", onset=onset)


def diagnose_in_full(baseline: Baseline, name: str, blocks: Sequence[Block]) -> Told:
    """Diagnose a window; seconds, refit included.

    Times in the document count from the beginning of the window, which it tells as ``began``; the summary has dates.
    """
    from servoscope.monitor import diagnose

    try:
        recording, begins = recording_of(baseline, name, blocks)
        said = diagnose(baseline, recording)
    except ServoscopeError as error:
        return Told("undetermined", f"Undetermined: {error}.", None, {})
    document = {"began": begins, **said.model_dump(mode="json")}
    if said.onset_s is None:
        return Told(said.verdict, said.summary, None, document)
    onset = begins + said.onset_s[1]
    # months later nobody knows when the window began
    summary = said.summary.replace(f"since {said.onset_s[1]:.1f} s", f"since {dated(onset)} UTC")
    summary = summary.replace("since the start of the recording or before", or_before(begins))
    return Told(said.verdict, summary, onset, document)


def begun_at(said: Told, onset: float | None) -> Told:
    """Return the diagnosis of a window, with an onset before it that is known from another one [UTC s]."""
    words = or_before(said.document.get("began", 0.0))
    if onset is None or words not in said.summary:
        return said
    return said._replace(summary=said.summary.replace(words, f"since {dated(onset)} UTC"), onset=onset)


def or_before(begins: float) -> str:
    """Return what is said of an onset at the beginning of a window, or before it."""
    return f"since {dated(begins)} UTC or before"
