"""Labelled recordings of faults beside a healthy baseline: which of them show the fault, and where it leads theta."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from servoscope.baseline import Baseline
from servoscope.diagnosis import UNKNOWN
from servoscope.errors import BaselineError, NotEnoughError
from servoscope.examination import Examination
from servoscope.isolation import worst_misfit
from servoscope.labelled import LearnedFault
from servoscope.plants import FloatArray
from servoscope.recording import Recording
from servoscope.steady import Steady, steady
from servoscope.verdict import judge

DISTINCT = 2.0  # times the limit of a misfit: a label that says less of its direction is refused (35 degrees)
LIKELY = 0.05  # probability from which another explanation of a labelled recording is told

Labelled = Mapping[str, Sequence[Recording]]


def label(baseline: Baseline, faults: Labelled, progress: Callable[[str], None] = lambda _: None) -> Baseline:
    """Return the baseline with faults learned from labelled recordings; the notes say what they are mistaken for.

    The fault has to be there to the end of its recordings; what comes before its onset is left out.

    Parameters
    ----------
    baseline
        Of one operating point.
    faults
        Recordings by the name of the fault that they show.
    progress
        Told what is being done.

    Raises
    ------
    BaselineError
        If a name is one of the plant's own faults.
    NotEnoughError
        If no recording of a fault differs from healthy, one is too short, or those of one name do not agree.
    """
    own = {UNKNOWN, *(fault.name for fault in baseline.loop.plant.faults)}
    learned, examined, notes = [], {}, list(baseline.notes)
    digest = hashlib.sha256(baseline.hash.encode())
    for name, recordings in faults.items():
        if name in own:
            raise BaselineError(
                f"fault {name}: the name is taken ({', '.join(sorted(own))} are): give the labelled recordings another"
            )
        progress(f"fault {name}")
        seen = [Examination.of(baseline, recording) for recording in recordings]
        examined[name] = shown = [x for x in seen if x.alarm.any()]
        if not shown:
            raise NotEnoughError(_silent(name, seen))
        silent = [x.recording.name for x in seen if not x.alarm.any()]
        notes += [f"{rec} is left out of {name}: it does not differ from healthy" for rec in silent]
        learned.append(_learn(name, shown, baseline.cov()))
        for array in (a for x in shown for a in (x.recording.t, x.recording.r, x.recording.u, x.recording.y)):
            digest.update(np.ascontiguousarray(array).tobytes())
        digest.update(name.encode())
    found = baseline.model_copy(update={"learned": tuple(learned), "hash": digest.hexdigest()[:16]})
    progress("faults compared")
    notes += [text for name, shown in examined.items() if (text := _mistaken(found, name, shown))]
    return found.model_copy(update={"notes": tuple(notes)})


def _moved(x: Examination) -> Steady:
    since = judge(x)[0].onset_s
    return steady(x, since[1] if since is not None else float(x.recording.t[0]))


def _learn(name: str, shown: Sequence[Examination], healthy: FloatArray) -> LearnedFault:
    moved = [_moved(x) for x in shown]
    deviations, covariances = (np.array([getattr(m, key) for m in moved]) for key in ("deviation", "covariance"))
    found = LearnedFault.of(name, [x.recording.name for x in shown], deviations, covariances, healthy)
    if min(found.shares) <= 0.0:
        odd = found.recordings[int(np.argmin(found.shares))]
        raise NotEnoughError(f"{odd} moves theta the other way than the other recordings of {name}: two labels?")
    if found.distinct < DISTINCT * worst_misfit(len(healthy)):
        raise NotEnoughError(
            f"the {len(shown)} recordings of {name} differ from each other as much as from healthy, and nearly any "
            "change would look like it: label them apart, or record more"
        )
    return found


def _silent(name: str, seen: Sequence[Examination]) -> str:
    if not seen:
        return f"{name}: no recording to learn from, give at least one"
    most = max(seen, key=lambda x: float(x.statistic.max(initial=0.0)))
    share = float(most.statistic.max(initial=0.0)) / most.baseline.limit
    which = most.recording.name if len(seen) == 1 else f"none of {len(seen)} recordings of it"
    verb = "does not differ" if len(seen) == 1 else "differs"
    return (
        f"{name}: {which} {verb} from healthy (T² reaches {share:.0%} of its limit), and what is not seen cannot be "
        "learned: record it more severe, under livelier motion or at another load"
    )


def _mistaken(baseline: Baseline, name: str, shown: Sequence[Examination]) -> str:
    """Say what else explains the labelled recordings of a fault, or nothing."""
    others: dict[str, int] = {}
    for x in shown:
        said = judge(replace(x, baseline=baseline))[0]
        for c in said.candidates:
            if c.name != name and c.probability >= LIKELY:
                others[c.name] = others.get(c.name, 0) + 1
    if not others:
        return ""
    listed = ", ".join(f"{other} ({count})" for other, count in others.items())
    return f"of {len(shown)} recordings of {name}, so many could be something else: {listed}"
