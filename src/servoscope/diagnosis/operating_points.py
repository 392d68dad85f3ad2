"""Learning at one or several operating points, and the comparison with an earlier baseline."""

from __future__ import annotations

import ctypes
import gc
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Literal

from servoscope.baseline.baseline import Baseline
from servoscope.baseline.records import BaselineSource
from servoscope.core.errors import BaselineError, NotEnoughError
from servoscope.core.messages import Message, message
from servoscope.core.verdict import FOUND
from servoscope.diagnosis import learn_faults
from servoscope.diagnosis.diagnose import diagnose
from servoscope.diagnosis.learn_faults import LabelledRecordings
from servoscope.evidence.population import MIN_MACHINES, Population
from servoscope.learning import learn as learning
from servoscope.learning.hold import with_likelier_hold
from servoscope.learning.learn import Progress
from servoscope.learning.plausibility import check_plausibility, check_wraps
from servoscope.models.loop import Loop
from servoscope.signals import Recording
from servoscope.signals.readers import as_recording
from servoscope.signals.readers.frames import Frame, Source, is_columns, is_frame
from servoscope.signals.recording import thin_out

MAX_SAMPLES = 250_000  # of all recordings, that are learned from: more take memory and time, and show little more
MIN_MEMORIES = 10.0  # of the estimator, in a stretch of a long recording
MIN_PROBABILITY_NOTED = 0.05  # probability from which a fault is noted that looks like another operating point


def learn(
    loop: Loop | str | Path,
    recordings: Recording
    | str
    | Path
    | Frame
    | Sequence[Recording | Source]
    | Mapping[str, Sequence[Recording | Source]],
    progress: Progress = lambda _: None,
    *,
    compare: Baseline | None = None,
    accept_change: bool = False,
    faults: LabelledRecordings | Mapping[str, LabelledRecordings] | None = None,
    accept_delay: bool = False,
    force: bool = False,
    population: Mapping[str, Baseline] | Sequence[Baseline | str | Path] = (),
    earlier: Baseline | None = None,
) -> Baseline:
    """Learn a baseline from healthy recordings, at one operating point or at several.

    With `compare`, no change of the machine is learned as healthy unnoticed.

    Parameters
    ----------
    loop
        The loop, or its path.
    recordings
        Healthy recordings, or what `read` reads (paths, frames, arrays by name), one or a list of them; by the name of
        their operating point (a load, a temperature, a tool, a season) where there are several,
        ``{"cold": [...], "warm": [...]}``.
    progress
        Called with the name of each step.
    compare
        An earlier baseline of the same machine; each recording is diagnosed with it first, at its own operating point
        if that baseline has it.
    accept_change
        Learn although a recording is a fault to the earlier baseline; the notes then say so.
    faults
        Recordings of known faults by name, ``{"backlash": [...]}``; `diagnose` then knows these faults too. Where
        operating points are named, by point first, ``{"cold": {"backlash": [...]}}``.
    accept_delay
        Learn although u and y are out of step by more than the loop file says; the notes then say so.
    force
        Learn although the coefficients are none that a machine has, or explain less than half of u; the notes then
        say so.
    population
        Baselines of like machines, or their paths, by name or in a list. How five or more differ is a prior, so that a
        new machine needs less healthy data of its own; a machine that is none of them is learned without, and the notes
        say which it was. Of fewer, the one of most recordings is the `earlier` one.
    earlier
        A baseline of more recordings, from before a repair or of a copy of the machine: what it knows of how healthy
        recordings scatter counts until this one has as many.

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
        If u and y are certainly out of step by more than the loop file says, and that is not accepted; if u or y wraps;
        if the coefficients are implausible, without `force`.
    LoopError
        If settings contradict each other.
    BaselineError
        If a recording is a fault to the earlier baseline and the change is not accepted, if a point has no name, or if
        a fault has the name of one that the plant knows, or a point that has no healthy recordings.

    Examples
    --------
    >>> baseline = learn("loop.toml", ["monday.csv", "tuesday.csv"])
    >>> baseline.names
    ('viscous_friction', 'inertia', 'coulomb_friction', 'offset')
    >>> baseline.save("baseline.json")
    """
    loop = Loop.of(loop)
    if isinstance(recordings, str | Path | Recording) or is_frame(recordings) or is_columns(recordings):
        recordings = [recordings]
    given = recordings if isinstance(recordings, Mapping) else {"": recordings}
    named = {name: [as_recording(source, loop) for source in some] for name, some in given.items()}
    for name, some in named.items():
        if not name and isinstance(recordings, Mapping):
            raise BaselineError("an operating point needs a name, as in {'cold': [...], 'warm': [...]}")
        if name and not some:
            raise NotEnoughError(f"operating point {name}: no recording to learn from, give at least one")
    if not named:
        raise NotEnoughError("no recording to learn from: give at least one healthy recording")
    labels = _group_by_point(faults or {}, recordings)
    notes = {name: compare_with_earlier(compare, name, some, progress, accept_change) for name, some in named.items()}
    loop, hold_notes = with_likelier_hold(loop, [recording for some in named.values() for recording in some])
    learned: list[Baseline] = []
    alikes = _named_machines(population)
    if len(alikes) < MIN_MACHINES:
        earlier = max([*alikes.values(), *filter(None, [earlier])], key=lambda prior: prior.scatter_from, default=None)
        alikes = {}
    for name, whole in named.items():
        some = _thin_out(loop, whole)
        check_wraps(some)
        like = Population.from_baselines(_machines_at(alikes, name)) if alikes else None
        before = earlier.at(name) if earlier is not None and name in earlier.points else earlier
        baseline = learning.learn_baseline(loop, some, progress, accept_delay, like, before)
        odd = check_plausibility(baseline, force or loop.implausible == "note")
        longest = max(some, key=lambda rec: rec.samples)
        progress("operating points")
        whole_notes = _judge_whole(baseline, whole, some)
        alike = [note for other in learned if (note := _resemblance_note(other, name, longest)) is not None]
        baseline = baseline.model_copy(
            update={
                "point": name,
                "sources": _whole_sources(baseline, whole, some),
                "notes": (*odd, *hold_notes, *baseline.notes, *notes[name], *whole_notes, *alike),
            }
        )
        learned.append(
            learn_faults.add_learned_faults(baseline, labels[name], progress) if name in labels else baseline
        )
    return learned[0].model_copy(update={"others": tuple(learned[1:])})


def _thin_out(loop: Loop, recordings: Sequence[Recording]) -> list[Recording]:
    """Return recordings of a bounded length in all; long ones are stretches of what they were."""
    samples = sum(rec.samples for rec in recordings)
    if samples <= MAX_SAMPLES:
        return list(recordings)
    # how a machine warms up shows in a whole beginning only
    memories = math.inf if loop.monitor.hidden_warm_up else MIN_MEMORIES
    shortest = round(min(memories * loop.monitor.memory * loop.sample_rate, MAX_SAMPLES))
    return [thin_out(rec, math.ceil(MAX_SAMPLES / samples * rec.samples), shortest) for rec in recordings]


def _whole_sources(
    baseline: Baseline, whole: Sequence[Recording], learned: Sequence[Recording]
) -> tuple[BaselineSource, ...]:
    """Return the recordings of a baseline as their files have them; those with a defect are not among them."""
    pairs = iter(zip(whole, learned, strict=True))
    return tuple(
        next(
            BaselineSource.from_recording(rec)
            for rec, part in pairs
            if (part.name, part.samples) == (source.name, source.samples)
        )
        for source in baseline.sources
    )


def _judge_whole(baseline: Baseline, whole: Sequence[Recording], learned: Sequence[Recording]) -> list[Message]:
    """Return what recordings are as a whole to a baseline that was learned from stretches of them."""
    longer = [(rec, part) for rec, part in zip(whole, learned, strict=True) if part.samples < rec.samples]
    if longer:
        gc.collect()  # what learning leaves in circles, a hundred megabytes, would add to what a long diagnosis takes
        with suppress(AttributeError, OSError, TypeError):  # only the GNU C library keeps it, and gives it back so
            ctypes.CDLL(None).malloc_trim(0)
    return [
        message(
            "learning.stretches",
            recording=rec.name,
            rows=part.samples,
            of=rec.samples,
            found=diagnose(baseline, rec).headline,
        )
        for rec, part in longer
    ]


def _named_machines(population: Mapping[str, Baseline] | Sequence[Baseline | str | Path]) -> dict[str, Baseline]:
    if isinstance(population, str | Path):
        raise TypeError("a population is a list of baselines, as in [path, path, ...]")
    if isinstance(population, Mapping):
        return dict(population)
    return {
        f"machine {i}" if isinstance(member, Baseline) else str(member): Baseline.of(member)
        for i, member in enumerate(population, 1)
    }


def _machines_at(machines: Mapping[str, Baseline], point: str) -> dict[str, Baseline]:
    """Return the machines' baselines of one operating point; those without points are of any."""
    return {name: machine.at(point) if point in machine.points else machine for name, machine in machines.items()}


def _group_by_point(
    faults: LabelledRecordings | Mapping[str, LabelledRecordings],
    recordings: Sequence[object] | Mapping[str, Sequence[object]],
) -> dict[str, LabelledRecordings]:
    """Return the labelled recordings of each operating point; the point of a baseline without points is ""."""
    groups: dict[str, dict[str, Sequence[Recording]]] = {}
    for key, value in faults.items():
        if isinstance(recordings, Mapping) != isinstance(value, Mapping):
            form = "{'cold': {'backlash': [...]}}" if isinstance(recordings, Mapping) else "{'backlash': [...]}"
            raise BaselineError(f"faults, {key}: give them by operating point where healthy ones are, as in {form}")
        if isinstance(value, Mapping):
            groups[key] = dict(value)
        else:
            groups.setdefault("", {})[key] = value
    for point in groups:
        if point and point not in recordings:
            raise BaselineError(f"faults at {point}: there are no healthy recordings at that operating point")
    return {point: labels for point, labels in groups.items() if labels}


def compare_with_earlier(
    earlier: Baseline | None,
    point: str,
    recordings: Sequence[Recording],
    progress: Progress,
    accept: bool,
    rank: Literal["earlier", "first"] = "earlier",
) -> list[Message]:
    """Return notes on what changed since an earlier baseline; raises BaselineError if the change is not accepted."""
    if earlier is None:
        return []
    progress("comparison")
    notes = []
    for rec in recordings:
        diagnosis = diagnose(earlier, rec, point=point if point in earlier.points else None)
        if diagnosis.verdict in FOUND and not accept:
            raise BaselineError(
                f"{rec.name} is not healthy by the {rank} baseline. {diagnosis.summary} Nothing was learned; find the "
                "cause, or accept the change (--accept-change)"
            )
        known = {"recording": rec.name, "hash": earlier.hash}
        if diagnosis.verdict in FOUND:
            notes.append(message("learning.accepted", **known, headline=diagnosis.headline))
        elif diagnosis.verdict == "undetermined":
            notes.append(message("learning.not_comparable", **known))
    return notes


def _resemblance_note(other: Baseline, point: str, recording: Recording) -> Message | None:
    """Return a note on which fault at another operating point looks like this point, or that both may be one."""
    diagnosis = diagnose(other, recording)
    if diagnosis.verdict == "healthy":
        return message("learning.one_point", recording=recording.name, other=other.point, point=point)
    likely = [fault for c in diagnosis.candidates if c.probability >= MIN_PROBABILITY_NOTED for fault in c.faults]
    if not likely:
        return None
    faults = tuple(message("learning.size", name=f.name, parameter=f.parameter, ratio=f.ratio) for f in likely)
    return message("learning.hidden_fault", faults=faults, other=other.point, point=point)
