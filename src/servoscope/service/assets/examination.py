"""The last minutes as a recording: examined in milliseconds while samples come in, diagnosed in full beside them."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import BaseModel, ConfigDict

from servoscope.baseline.baseline import Baseline
from servoscope.core.errors import ServoscopeError
from servoscope.core.messages import Message, message, render
from servoscope.core.verdict import VerdictKind
from servoscope.detection.covariate_monitor import CovariateHistory, fill_channels, window_recording
from servoscope.diagnosis.dates import TIMELINES
from servoscope.isolation.candidate import FaultEstimate
from servoscope.machines.kinds import MachineSource, to_machine
from servoscope.service.sources.block import Block
from servoscope.signals import Recording

if TYPE_CHECKING:  # its kernels are loaded when something is examined
    from servoscope.evidence.examination import Examination


KERNEL_SAMPLES = 400  # that bring all kernels of an examination to work


class StoredDiagnosis(BaseModel):
    """What the store keeps of an examination or a full diagnosis."""

    model_config = ConfigDict(frozen=True)

    verdict: VerdictKind  # at the end of the window
    headline: Message
    onset: float | None = None  # of the fault [UTC s]
    document: dict[str, Any] = {}  # of a diagnosis: as `diagnose --json` prints it
    # whether an alarm has gone that is still in the window: until it has left it, the window proves nothing
    recovering: bool = False
    control: str | None = None  # what the samples show by themselves, "" for nothing; None: not assessed
    size: FaultEstimate | None = None  # of the fault that was named before, as it is now; None: not known

    @property
    def summary(self) -> str:
        """The headline as text."""
        return render(self.headline)

    def columns(self, baseline: str) -> dict[str, Any]:
        """Return its columns in the table of diagnoses; `baseline`: hash of the one that it was made with."""
        document = {**self.document, "said": self.headline.model_dump(mode="json"), "baseline": baseline}
        return {"verdict": self.verdict, "summary": self.summary, "onset": self.onset, "document": document}

    def with_onset(self, onset: float | None) -> StoredDiagnosis:
        """Return it with the onset [UTC s] that an earlier window has found, if its own window begins after that."""
        if onset is not None and self.headline.key in TIMELINES:
            return self._with_timeline_from(onset)
        since = self.headline.values.get("since")
        if onset is None or since is None or since.key != "diagnosis.since_start_date":
            return self
        values = {**self.headline.values, "since": message("diagnosis.since_date", t=onset, growth=None)}
        return self.model_copy(update={"headline": message(self.headline.key, **values), "onset": onset})

    def _with_timeline_from(self, onset: float) -> StoredDiagnosis:
        first, *others = self.headline.values["stretches"]
        when = first.values["when"]
        if when.key == "diagnosis.stretch_until_date":
            when = message("diagnosis.stretch_when_date", from_s=onset, to_s=when.values["to_s"])
        elif when.key == "diagnosis.stretch_start_date":
            when = message("diagnosis.stretch_since_date", from_s=onset)
        else:
            return self
        first = first.model_copy(update={"values": {**first.values, "when": when}})
        values = {**self.headline.values, "stretches": (first, *others)}
        return self.model_copy(update={"headline": message(self.headline.key, **values), "onset": onset})


def undetermined(key: str, **values: Any) -> StoredDiagnosis:
    """Return that nothing could be determined, for the reason in a message of the section `service.examination`."""
    return StoredDiagnosis(verdict="undetermined", headline=message(f"service.examination.{key}", **values))


def examine_blocks(
    machine: MachineSource,
    name: str,
    blocks: Sequence[Block],
    features: float | None = None,
    fault: str | None = None,
    known: VerdictKind | None = None,
    assess: bool = False,
) -> StoredDiagnosis:
    """Examine the last minutes with the reference that was applied in them, without a refit.

    `features`: their score in the monitor, as a multiple of its limit. It has seen more spans than the last minutes
    hold, so its word counts where the coefficients are healthy. `fault`: the one that was named, to follow its size.
    `known`: the verdict that the store has already: the same one again has no document, which takes as long as the rest
    of the diagnosis. `assess`: whether to say what is wrong with the control, too.

    Where the samples cannot be used, the verdict is ``undetermined`` and the headline has the reason.
    """
    baseline = to_machine(machine).loop_baseline
    if baseline is None:
        return diagnose_blocks(machine, name, blocks)
    if assess:
        result = examine_blocks(baseline, name, blocks, features, fault, known)
        return result.model_copy(update={"control": _assess_blocks(baseline, name, blocks)})
    from servoscope.diagnosis.diagnose import diagnose_examination, judge_without_alarm
    from servoscope.evidence.examination import Examination
    from servoscope.evidence.kinds import findings

    try:
        recording, start = blocks_to_recording(baseline, name, blocks)
        exam = Examination.from_recording(baseline, recording, quick=True)
    except ServoscopeError as error:
        return undetermined("unusable", error=str(error))
    unusable, changed = next(findings(exam, "undetermined"), None), features is not None and features > 1.0
    if unusable is not None and not changed:
        return undetermined("unusable", error=unusable.text)
    if unusable is not None or not exam.alarm.any():
        if changed:
            headline = message("service.examination.features", excess=features)
            return StoredDiagnosis(verdict="fault", headline=headline, onset=None)
        size = _follow_size(exam, fault, 0) if fault is not None else None
        if known is not None:
            verdict, headline, _ = judge_without_alarm(exam)
            if verdict == known:
                return StoredDiagnosis(verdict=verdict, headline=headline, size=size if verdict == "healthy" else None)
        diagnosis, _ = diagnose_examination(exam)
        document, size = diagnosis.model_dump(mode="json"), size if diagnosis.verdict == "healthy" else None
        return StoredDiagnosis(verdict=diagnosis.verdict, headline=diagnosis.headline, document=document, size=size)
    if not exam.alarm[-1]:
        return undetermined("recovering").model_copy(update={"recovering": True})
    first = 0 if exam.alarm.all() else len(exam.alarm) - int(np.argmin(exam.alarm[::-1]))
    crossed = int(exam.estimates.crossed[first]) - 1
    onset = start + float(recording.t[crossed if crossed >= 0 else int(exam.estimates.index[first])])
    headline = message("service.examination.fault")
    size = _follow_size(exam, fault, first) if fault is not None else None
    return StoredDiagnosis(verdict="fault", headline=headline, onset=onset, size=size)


def _assess_blocks(baseline: Baseline, name: str, blocks: Sequence[Block]) -> str | None:
    """Return what the last minutes show by themselves, "" if nothing; None where the samples do not suffice."""
    from servoscope.assessment.assess import DOUBTS, judge

    try:
        verdict, _ = judge(blocks_to_recording(baseline, name, blocks)[0], name)
    except ServoscopeError:
        return None
    if verdict == "cannot tell":
        return None
    return verdict if verdict in DOUBTS else ""


def compile_examination(baseline: Baseline) -> None:
    """Examine some noise, so that samples do not wait for the compiler while an asset is first examined."""
    t = np.arange(KERNEL_SAMPLES) / baseline.loop.sample_rate
    covariates = np.zeros((0, 1)) if baseline.covariates is None else baseline.covariates.origin[:, None]
    signals = np.random.default_rng(0).normal(size=(3, t.size))
    held = np.tile(covariates[: len(baseline.logged_covariates)], t.size)
    with contextlib.suppress(ArithmeticError, np.linalg.LinAlgError):  # of numbers that mean nothing
        examine_blocks(baseline, "", [Block.from_signals("", 0, np.concatenate([t[None], signals, held]))])


def _follow_size(exam: Examination, fault: str, first: int) -> FaultEstimate | None:
    """Return the size of a fault at the end of the window, by the recursion; the alarm began at evaluation `first`.

    None where the coefficients are not where this fault alone would have moved them: then it has no size. A size that
    may be healthy is one as long as there is no alarm.
    """
    from servoscope.detection.onset import Onset
    from servoscope.diagnosis.batch_estimate import isolation_inputs
    from servoscope.isolation.isolate import isolate

    begin = int(exam.estimates.index[first]) if first else 0
    t = float(exam.recording.t[begin])
    onset = Onset(t, t, t, begin)
    try:
        signatures, deviation, covariance = isolation_inputs(exam, onset, exam.evaluations - 1)
        own = [signature for signature in signatures if signature.fault.name == fault]
        candidates = isolate(own, deviation, covariance)
    except (ServoscopeError, np.linalg.LinAlgError, ArithmeticError):
        return None
    best = candidates[0] if exam.alarm.any() else next((other for other in candidates if other.faults), candidates[0])
    return best.faults[0] if best.name == fault else None


def diagnose_blocks(machine: MachineSource, name: str, blocks: Sequence[Block]) -> StoredDiagnosis:
    """Diagnose a window, refit included, which takes seconds.

    What the machine adds to the diagnosis are further keys of the document. Times in the document count from the
    beginning of the window, its key ``began``; those of the headline are dates, because months later nobody knows when
    the window began.
    """
    try:
        signals = np.concatenate([block.signals for block in blocks], axis=1)
        diagnosis, start, _, details = to_machine(machine).judge_window(name, signals)
    except ServoscopeError as error:
        return undetermined("unusable", error=str(error))
    document = {**diagnosis.model_dump(mode="json"), "began": start, **details}
    onset = start + diagnosis.onset_s[1] if diagnosis.onset_s is not None else None
    headline = diagnosis.dated_headline(start)
    return StoredDiagnosis(verdict=diagnosis.verdict, headline=headline, onset=onset, document=document)


def carry_covariates(
    channels: Sequence[str], blocks: Sequence[Block], history: CovariateHistory, now: float
) -> Sequence[Block]:
    """Return blocks with what a monitor knows at `now` [UTC s] of covariates of which they have no value themselves."""
    if not history or not blocks:
        return blocks
    t, _, _, _, *rows = np.concatenate([block.signals for block in blocks], axis=1)
    filled = fill_channels(dict(zip(channels, rows, strict=True)), t - now, history)
    columns = np.split(np.array(list(filled.values())), np.cumsum([block.t.size for block in blocks])[:-1], axis=1)
    return [replace(block, covariates=own) for block, own in zip(blocks, columns, strict=True)]


def blocks_to_recording(baseline: Baseline, name: str, blocks: Sequence[Block]) -> tuple[Recording, float]:
    """Return blocks as a recording, whose time begins at 0, and the time of its beginning [UTC s].

    Raises RecordingError if they cannot be used as one.
    """
    return window_recording(baseline, name, np.concatenate([block.signals for block in blocks], axis=1))
