"""A loop file proposed from one log: columns, units, sample rate, plant, cutoff and memory, each with its evidence."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from servoscope.core import number_format
from servoscope.core.arrays import FloatArray
from servoscope.core.errors import IrregularTimeError, RecordingError, ServoscopeError
from servoscope.core.messages import Message, message, render
from servoscope.learning.inspection import Inspection, inspect
from servoscope.learning.inspection.model_order import MIN_FRICTION_GAIN, ModelOrderFit
from servoscope.models.loop import Columns, Loop, MonitorSettings
from servoscope.signals import Recording
from servoscope.signals.readers import ChannelInfo, read
from servoscope.signals.readers.axes import find_axes, signal_names
from servoscope.signals.readers.columns import LinearCombination, parse_combination
from servoscope.signals.readers.formats import open_file
from servoscope.signals.readers.guess_columns import FIELDS, guess_mapping, names_speed, quoted_channel
from servoscope.signals.readers.table import number_column
from servoscope.signals.readers.units import split_unit
from servoscope.signals.readers.wrap import find_wrap

MEMORIES = 10.0  # that a recording to learn from should have at least
MAX_MEMORY_S, MIN_PERIODS = 5.0, 5.0  # of the estimator; periods of the cutoff that it holds at least
MIN_TERM_GAIN = 0.005  # share of u that a higher order or a stiffness has to explain
JITTER_PERCENT = 5.0  # of a sample: standard deviation of the steps above which rows are resampled
SPEED_AXIS = {"kind": "axis", "y": "speed", "terms": ["viscous", "coulomb", "offset"]}
MIN_CLEAR_SHARE = 0.9  # share of u that a plant explains; below it, the choice is in doubt


@dataclass(frozen=True)
class ProposalLine:
    """A key of the loop file, its value as TOML, and why it is proposed; `doubtful`: somebody has to confirm it."""

    section: str
    key: str
    value: str
    why: Message
    doubtful: bool = False


@dataclass(frozen=True)
class LoopProposal:
    """A loop with the lines of its file."""

    loop: Loop
    lines: tuple[ProposalLine, ...]

    def to_toml(self, origin: str) -> str:
        """Return the loop file with comments; `origin`: the log that it was made from."""
        written = [f"# {render(message('init.origin', log=origin))}"]
        section = ""
        for line in self.lines:
            if line.section != section:
                section = line.section
                written += ["", f"[{section}]"]
            written.append(f"{line.key} = {line.value}".ljust(40) + f"  # {render(line.why)}")
        # names of columns and files may hold what neither a string nor a comment of TOML may
        return "".join(re.sub(r"[\0-\x1f\x7f]", lambda sign: f"\\u{ord(sign[0]):04X}", line) + "\n" for line in written)


def propose_columns(path: Path, channels: Sequence[ChannelInfo], axis: str | None = None) -> Columns:
    """Return the columns of a log by the words and units in their names; `axis`: of a file with several, which one.

    Raises RecordingError if no name suggests u or y, or the file has no such axis.
    """
    names = signal_names(channels)
    axes = find_axes(names)
    if axis is not None:
        if axis not in axes:
            has = f"it has {', '.join(axes)}" if axes else "its names show one axis; name the columns with --columns"
            raise RecordingError(f"{path}: no axis {axis!r}, {has}")
        names = axes[axis]
    fields = guess_mapping(names)
    missing = [letter for letter in "uy" if fields[FIELDS[letter]] is None]
    if missing:
        shown = ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
        raise RecordingError(
            f"{path}: no name suggests {' and '.join(missing)}: say which columns they are,"
            f" --columns 't=..., r=..., u=..., y=...'; the file has {shown}"
        )
    default = Columns()
    fields["reference"] = fields["reference"] or default.reference  # u stands for it where there is none
    return Columns.model_validate({**fields, "segment": ()})


def propose_loop(path: Path, columns: Columns) -> LoopProposal:
    """Return a loop for a log whose columns are known, as `inspect` measures it.

    Raises RecordingError if the log cannot be read, or nothing moves in it.
    """
    columns, wraps = _unwrapped_columns(path, columns)
    is_speed = names_speed(columns.outputs[0])
    try:
        recording = read(path, columns=columns)
        found = _inspect(recording, is_speed)
        irregular = found.sampling.jitter_percent > JITTER_PERCENT
    except IrregularTimeError:
        irregular = True
    if irregular:
        columns = columns.model_copy(update={"resample": True})
        recording = read(path, columns=columns)
        found = _inspect(recording, is_speed)
    best = found.best_order
    if best is None or found.suggested_cutoff_hz is None:
        raise RecordingError(f"{path}: {found.summary}")
    rate = float(f"{recording.sample_rate:.6g}")
    # the largest of two digits that the recommendation allows
    resampled = next((defect.text.values["cutoff"] for defect in recording.defects if defect.kind == "resampled"), None)
    cutoff = number_format.round_down(
        min(found.suggested_cutoff_hz, resampled if isinstance(resampled, float) else math.inf)
    )
    memory = max(MIN_PERIODS / cutoff, min(MAX_MEMORY_S, recording.duration_s / MEMORIES))
    memory = number_format.round_down(memory)
    frequencies = [f for f in MonitorSettings().frequencies if f <= cutoff] or [float(f"{cutoff / 2.0:.2g}")]
    settings = {
        "sample_rate": rate,
        "columns": columns.model_dump(exclude_none=True) | {"time": columns.time},
        "monitor": {"cutoff": cutoff, "memory": memory, "frequencies": frequencies},
    }

    def loop_of(plant: Mapping[str, object]) -> Loop:
        return Loop.from_dict({**settings, "plant": plant}, source=str(path))

    def explained_by(plant: Mapping[str, object]) -> float:
        fit = inspect(recording, loop_of(plant)).fit
        return 0.0 if fit is None else fit.explained

    # friction that changes its sign with y itself; what no rigid axis explains is a polynomial in s of its y
    plant, plant_lines = _propose_speed_axis(explained_by) if is_speed else ({}, ())
    if not plant:
        plant, plant_lines = _propose_polynomial(best, explained_by)
    loop = loop_of(plant)
    lines = (
        ProposalLine("", "sample_rate", repr(rate), message("init.rate", samples=recording.samples)),
        *_column_lines(columns, wraps, recording),
        *plant_lines,
        ProposalLine("monitor", "cutoff", repr(cutoff), message("init.cutoff")),
        ProposalLine("monitor", "memory", repr(memory), message("init.memory", length=recording.duration_s)),
        ProposalLine("monitor", "frequencies", repr(frequencies), message("init.frequencies")),
    )
    return LoopProposal(loop, lines)


def _inspect(recording: Recording, is_speed: bool) -> Inspection:
    """Inspect a recording before its plant is known; where y is a speed, that of a steady motion is no rest."""
    if not is_speed:
        return inspect(recording)
    return inspect(recording, Loop.from_dict({"sample_rate": recording.sample_rate, "plant": SPEED_AXIS}))


def _propose_speed_axis(
    explained_by: Callable[[Mapping[str, object]], float],
) -> tuple[Mapping[str, object], tuple[ProposalLine, ...]]:
    """Return a motor axis whose y is a speed with its lines, nothing where it does not explain u."""
    plain = SPEED_AXIS | {"terms": ["viscous", "offset"]}
    shares = [explained_by(plant) for plant in (SPEED_AXIS, plain)]
    rubs = 1.0 - shares[0] < (1.0 - MIN_FRICTION_GAIN) * (1.0 - shares[1])
    plant, share = (SPEED_AXIS, shares[0]) if rubs else (plain, shares[1])
    if share < MIN_CLEAR_SHARE:
        return {}, ()
    explained = message("init.axis", share=100.0 * share)
    return plant, (
        ProposalLine("plant", "kind", '"axis"', explained),
        ProposalLine("plant", "y", '"speed"', message("init.speed")),
        ProposalLine("plant", "terms", json.dumps(plant["terms"]), _friction_reason("coulomb" if rubs else "none")),
    )


def _propose_polynomial(
    best: ModelOrderFit, explained_by: Callable[[Mapping[str, object]], float]
) -> tuple[Mapping[str, object], tuple[ProposalLine, ...]]:
    """Return a polynomial in s with its lines."""

    def plant_of(order: int, stiffness: bool) -> dict[str, object]:
        known = {"kind": "polynomial", "order": order, "friction": best.friction}
        return {**known, "stiffness": stiffness, "offset": True}

    order, stiffness, share = best.order, best.stiffness, best.explained
    # beside friction, a higher order and a stiffness may explain what friction leaves over: the simpler plant is taken
    for simpler in ((order, False), (order - 1, False)):
        if simpler[0] and (found := explained_by(plant_of(*simpler))) > share - MIN_TERM_GAIN:
            order, stiffness, share = *simpler, found
    explained = message("init.explained", share=100.0 * share)
    return plant_of(order, stiffness), (
        ProposalLine("plant", "kind", '"polynomial"', message("init.kind")),
        ProposalLine("plant", "order", str(order), explained, share < MIN_CLEAR_SHARE),
        ProposalLine("plant", "friction", json.dumps(best.friction), _friction_reason(best.friction)),
        ProposalLine(
            "plant", "stiffness", json.dumps(stiffness), message("init.stiffness" if stiffness else "init.free")
        ),
        ProposalLine("plant", "offset", "true", message("init.offset")),
    )


def propose(path: str | Path, columns: Columns | None = None) -> tuple[LoopProposal, Inspection]:
    """Return a loop for a log, and what `inspect` says of the log with this loop.

    Parameters
    ----------
    path
        The log.
    columns
        Where the signals stand; None: as the names of the columns suggest.

    Raises RecordingError if the log cannot be read, nothing moves in it, or no name suggests u or y.
    """
    from servoscope.signals.readers import list_channels

    path = Path(path)
    proposal = propose_loop(path, columns or propose_columns(path, list_channels(path)))
    return proposal, inspect(read(path, proposal.loop), proposal.loop)


def _unwrapped_columns(path: Path, columns: Columns) -> tuple[Columns, dict[str, float]]:
    """Return the columns with those unwrapped that wrap, and the ranges in which the keys concerned do."""
    opened = open_file(path, columns.text)
    plain: dict[str, LinearCombination] = {}
    for key, text in (("reference", columns.reference), ("input", columns.input), ("output", columns.outputs[0])):
        try:
            combination = parse_combination(text, opened.columns, path.name)
        except ServoscopeError:  # the reference may be missing; what else is wrong is told when the log is read
            continue
        if len(combination.factors) == 1 and not combination.constant and not combination.wraps:
            plain[key] = combination
    if len(columns.outputs) > 1:
        plain.pop("output", None)
    wanted = [name for each in plain.values() for name in each.factors]
    pieces: dict[str, list[FloatArray]] = {name: [] for name in wanted}
    for table in opened.iter_chunks(wanted) if wanted else ():
        for name in wanted:
            pieces[name].append(number_column(table, name, "init"))
    changes, wraps = {}, {}
    for key, each in plain.items():
        ((name, factor),) = each.factors.items()
        if (period := find_wrap(np.concatenate(pieces[name]))) is not None:
            text = f"{quoted_channel(name)} % {period:.16g}"
            changes[key] = text if factor == 1.0 else f"{factor:.15g} * ({text})"
            wraps[key] = period
    return columns.model_copy(update=changes), wraps


def _column_lines(columns: Columns, wraps: Mapping[str, float], recording: Recording) -> list[ProposalLine]:
    lines = []
    if columns.time is not None:
        lines.append(ProposalLine("columns", "time", _quoted(columns.time), message("init.column")))
        lines.append(ProposalLine("columns", "time_unit", _quoted(columns.time_unit), message("init.time_unit")))
    for key, texts in (("reference", (columns.reference,)), ("input", (columns.input,)), ("output", columns.outputs)):
        unit = split_unit(texts[0].rpartition("* ")[2].strip("`"))[1]
        why = message("init.column_unit", unit=unit) if unit else message("init.column_plain")
        value = _quoted(texts[0]) if len(texts) == 1 else f"[{', '.join(map(_quoted, texts))}]"
        if key in wraps:
            why = message("init.wraps", range=wraps[key])
        lines.append(ProposalLine("columns", key, value, why, doubtful=(not unit and key == "output") or key in wraps))
    if columns.resample:
        how = next(defect.text for defect in recording.defects if defect.kind == "resampled")
        lines.append(ProposalLine("columns", "resample", "true", message("init.resample", how=how)))
    if columns.text is not None:
        given = columns.text.model_dump(exclude_defaults=True)
        value = ", ".join(f"{key} = {json.dumps(each, ensure_ascii=False)}" for key, each in given.items())
        lines.append(ProposalLine("columns", "text", f"{{{value}}}", message("init.layout")))
    return lines


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)


def _friction_reason(friction: str) -> Message:
    return message("init.no_friction") if friction == "none" else message("init.friction")
