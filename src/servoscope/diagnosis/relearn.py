"""Relearning: further healthy recordings join a baseline, or replace what was learned before a repair."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from servoscope.baseline.baseline import Baseline
from servoscope.baseline.history import history_folder, read_history, replace_baseline
from servoscope.baseline.records import RENEWALS, Occasion, Revision
from servoscope.core.errors import BaselineError
from servoscope.core.messages import Message, message
from servoscope.diagnosis.operating_points import MAX_SAMPLES, compare_with_earlier, learn
from servoscope.learning.learn import Progress
from servoscope.signals import Recording, readers
from servoscope.signals.readers import as_recording
from servoscope.signals.readers.frames import Source
from servoscope.signals.writers import plain_columns


def relearn(
    path: str | Path,
    recordings: Sequence[Recording | Source] | Mapping[str, Sequence[Recording | Source]],
    progress: Progress = lambda _: None,
    *,
    after: Occasion | None = None,
    who: str = "",
    why: str = "",
    accept_change: bool = False,
    accept_delay: bool = False,
    force: bool = False,
    folders: Sequence[Path] = (),
    leave_out: bool = False,
    save: bool = True,
) -> Baseline:
    """Learn a baseline anew with further healthy recordings, and put it in force; the earlier one is kept.

    Nothing is learned from a recording that is a fault to the baseline in force, or to the reference of its history:
    the first baseline, or that after the last accepted change. So a slow fault is not learned in small steps.

    Parameters
    ----------
    path
        The baseline file.
    recordings
        New healthy recordings, or what `read` reads; by the name of their operating point where the baseline has some.
        Operating points without new ones stay as they are.
    progress
        Called with the name of each step.
    after
        What was announced before them. After a repair, or a change of tool or product, they replace the earlier
        recordings; those of another season join them. In both cases a change is expected, and is noted instead of
        refused. None: nothing was done, and the recordings join the earlier ones.
    who, why
        Who relearned, and the reason; both are kept in the history.
    accept_change
        Learn although a recording is a fault; the notes then say so.
    accept_delay, force
        As in `learn`.
    folders
        Where earlier recordings are looked for, besides the folders of the baseline and of the new recordings.
    leave_out
        Leave out earlier recordings that are not found any more, and note it, instead of refusing.
    save
        Whether it is put in force; otherwise it is returned only, for a preview.

    Returns
    -------
    Baseline
        With its `revision`.

    Raises
    ------
    BaselineError
        If a recording is a fault and the change is not accepted, if the baseline is of another number of operating
        points, or if an earlier recording is not found in the folder of the baseline or of the new recordings.
    NotEnoughError, RecordingError, LoopError
        As in `learn`.
    OutputError
        If a file cannot be written.

    Examples
    --------
    >>> preview = relearn("baseline.json", ["wednesday.csv"], save=False)
    >>> preview.revision.number, len(preview.sources)
    (2, 3)
    """
    path, history = Path(path), read_history(Path(path))
    *_, earlier = history.values()
    loop, known = earlier.loop, earlier.revision
    given = recordings if isinstance(recordings, Mapping) else {"": recordings}
    if strange := set(given) - {baseline.point for baseline in earlier.per_point}:
        names = ", ".join(earlier.points) or "none"
        raise BaselineError(f"{path}: has no operating point {min(strange)!r}, choose from {names}")
    folders = [path.parent, history_folder(path), *folders]
    folders += [Path(source).parent for some in given.values() for source in some if isinstance(source, str | Path)]
    new = {point: [as_recording(source, loop) for source in some] for point, some in given.items()}
    notes: dict[str, list[Message]] = {}
    reference = history.get(known.reference, earlier)
    for point, some in new.items():
        notes[point] = compare_with_earlier(earlier, point, some, progress, accept_change or after is not None)
        if reference is not earlier:
            compare_with_earlier(reference, point, some, progress, accept_change or after is not None, "first")
    learned = {baseline.point: baseline for baseline in earlier.per_point if baseline.point in new}
    together = {point: list(new[point]) for point in learned}
    for previous in () if after in RENEWALS else learned.values():
        kept, missing = _earlier_recordings(path, previous, folders, leave_out)
        together[previous.point][:0] = kept
        notes[previous.point] += missing
    baseline = learn(
        loop, together.get("", together), progress, accept_delay=accept_delay, force=force, earlier=earlier
    )
    number = max(history) + 1
    changed = any(note.key == "learning.accepted" for some in notes.values() for note in some)
    revision = Revision(
        number=number,
        kind=after or "healthy",
        who=who,
        why=why,
        at=time.time(),
        parent=known.number,
        reference=number if changed or after in RENEWALS else known.reference,
    )
    for member in baseline.per_point:
        update = {"notes": (*member.notes, *notes.get(member.point, ())), "learned": learned[member.point].learned}
        learned[member.point] = member.model_copy(update=update)
    points = [learned.get(baseline.point, baseline) for baseline in earlier.per_point]
    baseline = points[0].model_copy(update={"others": tuple(points[1:]), "revision": revision})
    if save:
        replace_baseline(path, baseline)
    return baseline


def _earlier_recordings(
    path: Path, baseline: Baseline, folders: Sequence[Path], leave_out: bool
) -> tuple[list[Recording], list[Message]]:
    """Return the recordings that a baseline was learned from, and notes on those that are not found and left out."""
    recordings, missing = find_sources(baseline, folders)
    if missing and not leave_out:
        raise BaselineError(
            f"{path}: its recording {missing[0]} is not in {' or '.join(dict.fromkeys(map(str, folders)))}: put it "
            "there, or learn from the new recordings alone (after a repair, for example)"
        )
    return recordings, [message("learning.source_missing", recording=name) for name in missing]


def find_sources(baseline: Baseline, folders: Sequence[Path]) -> tuple[list[Recording], list[str]]:
    """Return the recordings that a baseline was learned from, and the names of those that are in none of the folders.

    A file of another number of samples, or of other samples, is another recording. Samples that a service kept have
    their own columns.
    """
    loop, recordings, missing = baseline.loop, list[Recording](), list[str]()
    # baselines of 1.0 have no hashes, and of recordings that were long together the samples that were learned from
    shortened = sum(source.samples for source in baseline.sources) > 0.9 * MAX_SAMPLES
    own = plain_columns(loop.columns.covariates)
    for source in baseline.sources:
        files = [folder / source.name for folder in folders if (folder / source.name).is_file()]
        for file in files:
            recording = readers.read(file, loop, columns=own if file.parent.suffix == ".history" else None)
            if source.fits(recording) or (shortened and not source.hash and recording.samples > source.samples):
                recordings.append(recording)
                break
        else:
            missing.append(source.name)
    return recordings, missing
