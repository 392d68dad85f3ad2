"""Operating points: one baseline for each, told apart; a change is accepted in so many words or not at all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from servoscope import labelling, learning
from servoscope.baseline import Baseline
from servoscope.errors import BaselineError, NotEnoughError
from servoscope.labelling import Labelled
from servoscope.learning import Progress
from servoscope.loop import Loop
from servoscope.monitor import diagnose
from servoscope.recording import Recording

LIKELY = 0.05  # probability from which a fault is said to look like another operating point


def learn(
    loop: Loop,
    recordings: Sequence[Recording] | Mapping[str, Sequence[Recording]],
    progress: Progress = lambda _: None,
    *,
    compare: Baseline | None = None,
    accept_change: bool = False,
    faults: Labelled | Mapping[str, Labelled] | None = None,
) -> Baseline:
    """Learn what healthy looks like, at one operating point or at several.

    Nothing is ever learned unasked, and with `compare` no change is learned unnoticed.

    Parameters
    ----------
    loop
        The loop.
    recordings
        Healthy recordings, one or more; by the name of their operating point (a load, a temperature, a tool, a season)
        where there are several, ``{"cold": [...], "warm": [...]}``.
    progress
        Told what is being done.
    compare
        An earlier baseline of the same machine; each recording is diagnosed with it first, at its own operating point
        if that baseline has it.
    accept_change
        Learn although a recording is a fault to the earlier baseline; the notes then say so.
    faults
        Recordings of known faults by name, ``{"backlash": [...]}``; `diagnose` then knows these faults too. Where
        operating points are named, by point first, ``{"cold": {"backlash": [...]}}``.

    Returns
    -------
    Baseline
        With `points` and `at(name)` where operating points were named.

    Raises
    ------
    NotEnoughError
        If the recordings are too short or excite too little, if a point has none, or if those of a fault do not
        differ from healthy.
    RecordingError
        If u and y are out of step by more than the loop file says.
    LoopError
        If the settings do not go together.
    BaselineError
        If a recording is a fault to the earlier baseline and the change is not accepted, if a point has no name, or if
        a fault has the name of one that the plant knows, or a point that has no healthy recordings.
    """
    named = recordings if isinstance(recordings, Mapping) else {"": recordings}
    for name, some in named.items():
        if not name and isinstance(recordings, Mapping):
            raise BaselineError("an operating point needs a name, as in {'cold': [...], 'warm': [...]}")
        if name and not some:
            raise NotEnoughError(f"operating point {name}: no recording to learn from, give at least one")
    if not named:
        raise NotEnoughError("no recording to learn from: give at least one healthy recording")
    labels = _by_point(faults or {}, recordings)
    notes = {name: _changes(compare, name, some, progress, accept_change) for name, some in named.items()}
    learned: list[Baseline] = []
    for name, some in named.items():
        one = learning.learn(loop, some, progress)
        longest = max(some, key=lambda rec: rec.samples)
        progress("operating points")
        told = [text for other in learned if (text := _resembles(other, name, longest))]
        one = one.model_copy(update={"point": name, "notes": (*one.notes, *notes[name], *told)})
        learned.append(labelling.label(one, labels[name], progress) if name in labels else one)
    return learned[0].model_copy(update={"others": tuple(learned[1:])})


def _by_point(
    faults: Labelled | Mapping[str, Labelled], recordings: Sequence[Recording] | Mapping[str, Sequence[Recording]]
) -> dict[str, Labelled]:
    """Return the labelled recordings of each operating point; the point of a baseline without points is "".

    Raises
    ------
    BaselineError
        If points and faults do not go together.
    """
    found: dict[str, dict[str, Sequence[Recording]]] = {}
    for key, value in faults.items():
        if isinstance(recordings, Mapping) != isinstance(value, Mapping):
            how = "{'cold': {'backlash': [...]}}" if isinstance(recordings, Mapping) else "{'backlash': [...]}"
            raise BaselineError(f"faults, {key}: give them by operating point where healthy ones are, as in {how}")
        if isinstance(value, Mapping):
            found[key] = dict(value)
        else:
            found.setdefault("", {})[key] = value
    for point in found:
        if point and point not in recordings:
            raise BaselineError(f"faults at {point}: there are no healthy recordings at that operating point")
    return {point: labels for point, labels in found.items() if labels}


def _changes(
    earlier: Baseline | None, point: str, recordings: Sequence[Recording], progress: Progress, accept: bool
) -> list[str]:
    """Say what changed since an earlier baseline.

    Raises
    ------
    BaselineError
        If something did and that is not accepted.
    """
    if earlier is None:
        return []
    progress("comparison")
    notes = []
    for rec in recordings:
        said = diagnose(earlier, rec, point=point if point in earlier.points else None)
        if said.verdict == "fault" and not accept:
            raise BaselineError(
                f"{rec.name} is not healthy to the earlier baseline. {said.summary} Nothing was learned; find the "
                "cause, or accept the change (--accept-change)"
            )
        if said.verdict == "fault":
            notes.append(
                f"accepted as healthy, against the earlier baseline {earlier.hash}: {rec.name}. {said.summary}"
            )
        elif said.verdict == "undetermined":
            notes.append(f"{rec.name} shows too little to be compared with the earlier baseline {earlier.hash}")
    return notes


def _resembles(other: Baseline, point: str, recording: Recording) -> str:
    """Say which fault at another operating point looks like this one, or that the two are one; or nothing."""
    said = diagnose(other, recording)
    if said.verdict == "healthy":
        return f"{recording.name} is healthy at {other.point} too: {other.point} and {point} may be one operating point"
    likely = [fault for c in said.candidates if c.probability >= LIKELY for fault in c.faults]
    if not likely:
        return ""
    listed = " or ".join(f"{fault.name} ({fault.parameter} x {fault.ratio:.3g})" for fault in likely)
    return (
        f"{point} differs from {other.point} as {listed} would: such a fault at {other.point} is taken for {point} and "
        "stays hidden, unless the operating point is given (--point)"
    )
