"""A diagnosis repeated from its file: the same versions, the same data, the same verdict."""

from __future__ import annotations

import hashlib
import json
import platform
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from servoscope.baseline.baseline import Baseline
from servoscope.core.errors import RecordingError
from servoscope.core.messages import Message, message
from servoscope.core.verdict import VerdictKind
from servoscope.diagnosis.diagnose import diagnose
from servoscope.diagnosis.result import Diagnosis, Provenance
from servoscope.signals import Recording

__all__ = ["Verification", "load_diagnosis", "provenance", "verify"]

SIZE_TOLERANCE = 1e-6  # relative difference of sizes that another processor may make


class Verification(BaseModel):
    """Whether a diagnosis comes out again, and what is not as it was."""

    model_config = ConfigDict(frozen=True)

    same: bool  # the verdict, the named faults, and the data that they were made from
    differences: tuple[Message, ...]  # of verdict and data
    remarks: tuple[Message, ...]  # other versions, sizes that moved, what the file does not say
    repeated: Diagnosis


def provenance(baseline: Baseline, recording: Recording) -> Provenance:
    """Return what a diagnosis is made with, and hashes of what it is made from."""
    from servoscope import __version__

    content = baseline.model_dump(mode="json", by_alias=True, exclude_defaults=True)
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    samples = hashlib.sha256()
    for column in (recording.t, recording.r, recording.u, recording.y, *recording.channels.values()):
        samples.update(np.ascontiguousarray(column, dtype=np.float64).tobytes())
    return Provenance(
        servoscope=__version__,
        python=platform.python_version(),
        numpy=np.__version__,
        baseline=hashlib.sha256(text.encode()).hexdigest()[:16],
        recording=samples.hexdigest()[:16],
    )


def load_diagnosis(path: Path) -> Diagnosis:
    """Read what ``diagnose --json`` printed.

    Raises RecordingError if the file is missing or holds no diagnosis.
    """
    try:
        return Diagnosis.model_validate(json.loads(path.read_text(encoding="utf-8")))
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror or error})") from None
    except (ValueError, ValidationError, RecursionError):
        raise RecordingError(
            f"{path}: is not one diagnosis; give what servoscope diagnose --json printed for one recording"
        ) from None


def verify(told: Diagnosis, baseline: Baseline, recording: Recording) -> Verification:
    """Diagnose a recording again and compare the result with what was told.

    Parameters
    ----------
    told
        The diagnosis to repeat.
    baseline, recording
        What it is said to be made from.
    """
    point = told.point if told.point is not None and told.point in baseline.points else None
    before: VerdictKind = "suspect" if told.verdict == "fault" else "undetermined"  # a fault may rest on two in a row
    again = diagnose(baseline, recording, point=point, before=before)
    now, then = provenance(baseline, recording), told.provenance
    differences, remarks = list[Message](), list[Message]()
    if then is None:
        remarks.append(message("verify.no_provenance"))
    else:
        for what in ("recording", "baseline"):
            if getattr(then, what) != getattr(now, what):
                differences.append(message(f"verify.other_{what}", then=getattr(then, what), now=getattr(now, what)))
        for what in ("servoscope", "python", "numpy"):
            if getattr(then, what) != getattr(now, what):
                remarks.append(
                    message("verify.other_version", what=what, then=getattr(then, what), now=getattr(now, what))
                )
    if told.samples != again.samples:
        differences.append(message("verify.other_samples", then=told.samples, now=again.samples))
    if told.verdict != again.verdict:
        differences.append(message("verify.other_verdict", then=told.verdict, now=again.verdict))
    names = [tuple(fault.name for fault in diagnosis.faults) for diagnosis in (told, again)]
    if names[0] != names[1]:
        none = message("verify.no_fault")
        differences.append(message("verify.other_faults", then=names[0] or (none,), now=names[1] or (none,)))
    else:
        for old, new in zip(told.faults, again.faults, strict=True):
            if abs(new.ratio - old.ratio) > SIZE_TOLERANCE * abs(old.ratio):
                remarks.append(message("verify.other_size", parameter=old.parameter, then=old.ratio, now=new.ratio))
    return Verification(same=not differences, differences=tuple(differences), remarks=tuple(remarks), repeated=again)
