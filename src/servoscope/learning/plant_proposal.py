"""The plant of a proposed loop file: the candidate that the logs can be learned with, and the lines that say so."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from servoscope.core.errors import NotEnoughError, RecordingError
from servoscope.core.messages import Message, message
from servoscope.learning.inspection.rules import GOOD_EXPLAINED_SHARE
from servoscope.learning.loop_proposal import ProposalLine, quoted
from servoscope.learning.plant_choice import PlantCandidate
from servoscope.learning.plausibility import describe_negative, negative_values
from servoscope.learning.recursion import tune_pipeline
from servoscope.models.loop import Columns, Loop
from servoscope.models.plants import plant_class
from servoscope.signals import Recording
from servoscope.signals.readers import list_channels
from servoscope.signals.readers.guess_columns import guess_pressures
from servoscope.signals.readers.units import split_unit

MAX_TRIALS = 6  # plants that are tried where learning refuses the supported one
MAX_LEFT_RATIO = 2.0  # what another one may leave of u, over what the supported one leaves
VALVE = re.compile(r"valve|ventil(?!at)|vanne|valvola|válvula|spool|schieber|阀", re.IGNORECASE)
CYLINDER = re.compile(r"cylinder|zylinder|vérin|cilindro|hydraul|油缸", re.IGNORECASE)
POSITION = re.compile(r"pos|lage|weg|winkel|angle|theta|stroke|displacement|hub|位置|角度", re.IGNORECASE)


def names_valve(columns: Columns) -> bool:
    """Tell whether the names of columns are those of a cylinder behind a valve."""
    return VALVE.search(columns.input) is not None or any(CYLINDER.search(y) for y in columns.outputs)


def names_no_position(columns: Columns) -> bool:
    """Tell whether neither a unit nor a word in the name of y says what it is."""
    name = columns.outputs[0].rpartition("* ")[2].strip("`")
    return not split_unit(name)[1] and POSITION.search(name) is None


def choose_learnable(
    candidates: Sequence[PlantCandidate],
    loop_of: Callable[[Mapping[str, object]], Loop],
    recordings: Sequence[Recording],
) -> tuple[PlantCandidate, Message | None]:
    """Return the first plant that can be learned, or the supported one with the reason why it cannot.

    Raises NotEnoughError where a recording has too few samples for it, RecordingError where no plant explains anything.
    """
    supported, *others = candidates
    if not supported.explained > 0.0:
        raise RecordingError(
            f"not usable: no plant explains u of {recordings[0].name} on rows that it was not fitted to: which columns"
            " are u and y, and do they belong to one axis?"
        )
    odd = why_not_learned(loop_of(supported.settings), recordings)
    if odd is None:
        return supported, None
    most = MAX_LEFT_RATIO * (1.0 - supported.explained)
    near = [other for other in others if other.plausible and 1.0 - other.explained <= most]
    for other in near[:MAX_TRIALS]:
        try:
            if why_not_learned(loop_of(other.settings), recordings) is None:
                return other, None
        except NotEnoughError:
            continue
    return supported, odd


def why_not_learned(loop: Loop, recordings: Sequence[Recording]) -> Message | None:
    """Return which coefficients no machine has, by the steps that `learn` begins with; None where it goes on.

    Raises NotEnoughError where it has too few samples.
    """
    pipeline, _, fit = tune_pipeline(loop, recordings)
    names = pipeline.bank.names
    std = np.sqrt(np.diag(fit.covariance))
    below = negative_values(names, fit.tuning.theta, std, fit.tuning.scale / fit.rms_eta)
    return describe_negative(below, names) if below else None


def with_pressures(chosen: PlantCandidate, path: Path, columns: Columns) -> PlantCandidate:
    """Return a plant with the columns of pressures, where it takes some and the log has them."""
    takes = "pressures" in plant_class(chosen.settings["kind"]).model_fields
    pressures = guess_pressures([channel.name for channel in list_channels(path, columns.text)]) if takes else None
    return chosen if pressures is None else replace(chosen, settings={**chosen.settings, "pressures": pressures})


def plant_lines(chosen: PlantCandidate, by_values: bool) -> list[ProposalLine]:
    """Return the section on the plant; constant forces are part of each. `by_values`: how y was known for a speed."""
    share = chosen.explained
    explained = message("init.explained", share=100.0 * share)
    lines = []
    for key, value in chosen.settings.items():
        why = explained if key == "kind" else message(f"init.of_{key}")
        written = json.dumps(value, ensure_ascii=False)
        if isinstance(value, Mapping):
            written = f"{{{', '.join(f'{name} = {quoted(text)}' for name, text in value.items())}}}"
        doubtful = key == "kind" and share < GOOD_EXPLAINED_SHARE
        if key == "y" and by_values:
            why, doubtful = message("init.y_by_values"), True
        lines.append(ProposalLine("plant", key, written, why, doubtful))
    return lines
