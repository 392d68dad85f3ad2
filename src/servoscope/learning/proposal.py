"""A loop file proposed from logs: columns, units, sample rate, plant, cutoff and memory, each with its evidence."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from pydantic import ValidationError

from servoscope.core.blas import with_one_blas_thread
from servoscope.core.errors import IrregularTimeError, LoopError, NotEnoughError, RecordingError, ServoscopeError
from servoscope.core.messages import Message, message
from servoscope.core.settings_errors import describe_error
from servoscope.learning.hold import likelier_hold
from servoscope.learning.inspection import Inspection, inspect
from servoscope.learning.inspection.cutoff import measure_cutoff
from servoscope.learning.inspection.inspect import inspect_motion
from servoscope.learning.loop_proposal import LoopProposal, ProposalLine, quoted
from servoscope.learning.monitor_proposal import hold_at_rest, hold_lines, monitor_lines, monitor_settings
from servoscope.learning.plant_choice import PlantCandidate, choose_plant
from servoscope.learning.plant_proposal import (
    choose_learnable,
    names_no_position,
    names_valve,
    plant_lines,
    with_pressures,
)
from servoscope.models.loop import Columns, Loop
from servoscope.signals import Recording
from servoscope.signals.readers import ChannelInfo, list_channels, read
from servoscope.signals.readers.axes import axes_of, own_clock, signal_names, signals_of_one_axis
from servoscope.signals.readers.columns import LinearCombination, header_hint, parse_combination, parse_fields
from servoscope.signals.readers.formats import open_file
from servoscope.signals.readers.frames import Source, is_frame, write_source
from servoscope.signals.readers.guess_columns import (
    FIELDS,
    guess_mapping,
    mapping_template,
    names_speed,
    names_target_torque,
    quoted_channel,
    turned_channel,
)
from servoscope.signals.readers.select import chosen_values
from servoscope.signals.readers.table import read_part
from servoscope.signals.readers.units import split_unit
from servoscope.signals.readers.wrap import find_wrap

PART_ROWS = 400_000  # of a log, that are looked at; more are read in whole chunks
JITTER_PERCENT = 5.0  # of a sample: standard deviation of the steps above which rows are resampled
SPEED_AXIS = {"kind": "axis", "y": "speed", "terms": ["viscous", "coulomb", "offset"]}
# what may move the healthy coefficients, by what its name contains
COVARIATE_STEMS = {
    "temperature": ("temp", "°c", "degc", "温度"),
    "supply": ("volt", "supply", "pressure", "druck", "pression"),
    "load": ("load", "carga", "humid"),
}
MIN_SLOW_SHARE = 0.5  # of the variance of a covariate, that lies between memories: what is faster follows the motion
MAX_SPAN_RATIO = 8.0  # of r over y, or y over r, beyond which one of them is in another unit


def propose_columns(
    path: Path, channels: Sequence[ChannelInfo], axis: str | None = None, given: str | None = None
) -> Columns:
    """Return the columns of a log by the words and units in their names.

    `axis`: of a file with several, which one; `given`: what the user says of columns, as ``"u=cur"``; the others are
    guessed. Raises RecordingError if no name suggests u or y, or the file has no such axis, LoopError if `given` cannot
    be read.
    """
    if axis is not None:
        axes = axes_of(channels)
        if axis not in axes:
            has = f"it has {', '.join(axes)}" if axes else "its names show one axis; name the columns with --columns"
            raise RecordingError(f"{path}: no axis {axis!r}, {has}")
        channels = [channel for channel in channels if channel.name in axes[axis]]
    told = parse_fields(given) if given else {}
    texts = [str(text) for value in told.values() for text in (value if isinstance(value, tuple) else (value,))]
    # a column that the user names is no other signal
    used = {*texts, *(word for text in texts for pair in re.findall(r"`([^`]+)`|([\w.]+)", text) for word in pair)}
    names = signal_names(channels) if axis is not None else signals_of_one_axis(channels, used)
    fields = {**guess_mapping([name for name in names if name not in used]), **told}
    fields |= {} if "time" in told else own_clock(channels, fields["output"])
    missing = [letter for letter in "uy" if fields[FIELDS[letter]] is None]
    if missing:
        shown = ", ".join(names[:12]) + (", ..." if len(names) > 12 else "") + header_hint(names)
        if texts := [channel.name for channel in channels if channel.dtype == "string"]:
            shown += f"; text in {', '.join(texts[:12])}: --comment leaves out lines that hold no row"
        raise RecordingError(
            f"{path}: no name suggests {' and '.join(missing)}: say which columns they are,"
            f" {mapping_template(fields)}; the file has {shown}"
        )
    fields["reference"] = fields["reference"] or Columns().reference  # u stands for it where there is none
    try:
        return Columns.model_validate({"segment": (), **fields})
    except ValidationError as error:
        raise LoopError(f"columns: {describe_error(error, Columns)}") from None


def propose_loop(
    paths: Sequence[Path],
    columns: Columns,
    where: Mapping[str, str] | None = None,
    *,
    kind: str | None = None,
    is_speed: bool | None = None,
) -> LoopProposal:
    """Return a loop for logs whose columns are known, as `inspect` measures the first of them; `where`: as in `read`.

    `kind`: of the plant, where it is known; `is_speed`: whether y is a speed, by its name where that is not said. Logs
    that do not go with the first are left out, with a note. What is proposed was tried: `learn` does not refuse it.

    Raises RecordingError: the first is unreadable, or at rest; nothing explains u; too few samples can be used.
    """
    path = paths[0]
    columns, wraps = _unwrapped_columns(path, columns, where)
    by_values, is_speed = is_speed is not None, names_speed(columns.outputs[0]) if is_speed is None else is_speed
    columns, read_logs, inspection, bands, notes = _read_logs(paths, columns, where, is_speed)
    recordings = [log for _, log in read_logs]
    recording = recordings[0]
    monitor = monitor_settings(recording, bands)
    settings: dict[str, object] = _settings(recording, columns)

    def loop_of(plant: Mapping[str, object]) -> Loop:
        return Loop.from_dict({**settings, "plant": plant, "monitor": monitor}, source=str(path))

    try:
        candidates = _compare_plants(recordings, columns, inspection, loop_of, is_speed, kind)
        if candidates[0].reversed and not re.search(r" [+-] |^-", columns.input):
            turned = columns.model_copy(update={"input": turned_channel(columns.input)})
            return propose_loop(paths, turned, where, kind=kind, is_speed=is_speed if by_values else None)
        if not is_speed and candidates[0].settings.get("y") == "speed":
            return propose_loop(paths, columns, where, kind=kind, is_speed=True)
        chosen, odd = choose_learnable(candidates, loop_of, recordings)
    except (NotEnoughError, RecordingError) as error:
        raise RecordingError(f"{path.name}: {error}") from None
    chosen = with_pressures(chosen, path, columns)
    if odd is not None:
        settings["implausible"] = "note"
    hold = likelier_hold(loop_of(chosen.settings), recordings)
    if hold is not None:
        settings["hold"] = hold.hold
    inspected = inspect(recording, loop_of(chosen.settings))
    held = hold_at_rest(inspected, monitor, lambda: loop_of(chosen.settings), recordings)
    loop = loop_of(chosen.settings)
    further, told = _further_columns(path, columns, where, max(round(loop.monitor.memory * loop.sample_rate), 1))
    lines = (
        ProposalLine("", "sample_rate", repr(loop.sample_rate), message("init.rate", samples=recording.samples)),
        *hold_lines(hold),
        *([] if odd is None else [ProposalLine("", "implausible", '"note"', message("init.odd", reason=odd), True)]),
        *_column_lines(path, columns, wraps, recording),
        *further,
        *plant_lines(chosen, by_values),
        *monitor_lines(monitor, recording.duration_s),
        *held,
    )
    if chosen.rival is not None:
        notes.append(message("init.rival", kind=chosen.rival, plant=str(chosen.settings["kind"])))
    others = (other for other in candidates if other.words != chosen.words)
    inspections = [(log, inspect(rec, loop)) for log, rec in read_logs[not held :]]
    inspections = inspections if held else [(path, inspected), *inspections]
    return LoopProposal(loop, lines, (chosen, *others), (*notes, *told), path.name, tuple(inspections))


def _compare_plants(
    recordings: Sequence[Recording],
    columns: Columns,
    inspection: Inspection,
    loop_of: Callable[[Mapping[str, object]], Loop],
    is_speed: bool,
    kind: str | None,
) -> tuple[PlantCandidate, ...]:
    """Return the plants that are compared, with what the names of the columns say of them."""
    assert inspection.rest is not None, "what has an order has moved"
    return choose_plant(
        recordings,
        loop_of({"kind": "polynomial", "order": 1}).cutoff,
        is_speed,
        inspection.rest.speed,
        kind=kind,
        has_valve=names_valve(columns),
        may_be_speed=not is_speed and names_no_position(columns),
    )


def _settings(recording: Recording, columns: Columns) -> dict[str, object]:
    """Return the part of a loop file that is not chosen."""
    rate = float(f"{recording.sample_rate:.6g}")
    return {"sample_rate": rate, "columns": columns.model_dump(exclude_none=True) | {"time": columns.time}}


def _read_logs(
    paths: Sequence[Path], columns: Columns, where: Mapping[str, str] | None, is_speed: bool
) -> tuple[Columns, list[tuple[Path, Recording]], Inspection, list[float], list[Message]]:
    """Return the logs, what `inspect` measures of the first, the cutoffs of all, and what was left out."""
    columns, recording, inspection = _read_evenly(paths[0], columns, where, is_speed)
    if inspection.best_order is None or inspection.suggested_cutoff_hz is None:
        raise RecordingError(str(inspection.summary))
    monitor = monitor_settings(recording, [inspection.suggested_cutoff_hz])
    plant = {"kind": "polynomial", "order": 1}
    loop = Loop.from_dict({**_settings(recording, columns), "plant": plant, "monitor": monitor})
    logs, bands, notes = [(paths[0], recording)], [inspection.suggested_cutoff_hz], []
    for path in paths[1:]:
        try:
            further = read(path, loop, where=where)
        except ServoscopeError as error:
            notes.append(message("init.left_out", reason=str(error)))
            continue
        logs.append((path, further))
        bands.append(measure_cutoff(further, is_speed))
    return columns, logs, inspection, bands, notes


def _read_evenly(
    path: Path, columns: Columns, where: Mapping[str, str] | None, is_speed: bool
) -> tuple[Columns, Recording, Inspection]:
    """Return the first log and what `inspect` measures of it, resampled where its rows are not evenly spaced."""
    try:
        recording = read(path, columns=columns, where=where)
        inspection = _inspect(recording, is_speed)
        if inspection.sampling.jitter_percent <= JITTER_PERCENT:
            return columns, recording, inspection
    except IrregularTimeError:
        pass
    columns = columns.model_copy(update={"resample": True})
    recording = read(path, columns=columns, where=where)
    return columns, recording, _inspect(recording, is_speed)


def _inspect(recording: Recording, is_speed: bool) -> Inspection:
    """Inspect a recording before its plant is known; where y is a speed, that of a steady motion is no rest."""
    if not is_speed:
        return inspect_motion(recording, None)
    return inspect_motion(recording, Loop.from_dict({"sample_rate": recording.sample_rate, "plant": SPEED_AXIS}))


def _further_columns(
    path: Path, columns: Columns, where: Mapping[str, str] | None, memory: int
) -> tuple[list[ProposalLine], list[Message]]:
    """Return a line with covariates, and what else columns are, by their names and values.

    `memory`: of the estimator [samples]; what changes within it follows the motion and is no covariate.
    """
    mapped = " ".join([columns.reference, columns.input, *columns.outputs, columns.time or ""])
    opened = open_file(path, columns.text)
    channels = (c for c in list_channels(path, columns.text) if c.name != c.clock)
    moving = [channel.name for channel in channels if channel.name not in mapped and channel.min < channel.max]
    notes = [message("init.target_torque", name=name) for name in moving if names_target_torque(name)]
    kinds = {
        name: kind
        for kind, stems in COVARIATE_STEMS.items()
        for name in moving
        if any(stem in name.casefold() for stem in stems) and not names_target_torque(name)
    }
    slow = {}
    for name, values in chosen_values(opened, list(kinds), where).items():
        x = values[np.isfinite(values)]
        if not x.size or x.min() == x.max():  # in the chosen rows
            continue
        blocks = np.array_split(x, max(x.size // memory, 1))
        if np.var([block.mean() for block in blocks]) >= MIN_SLOW_SHARE * np.var(x):
            slow[re.sub(r"\W+", "_", split_unit(name)[0]).strip("_").lower() or kinds[name]] = name
            low, high = float(x.min()), float(x.max())
            notes.append(message("init.covariate", name=name, low=low, high=high, why=message(f"init.{kinds[name]}")))
        else:
            notes.append(message("init.moves", name=name))
    if not slow:
        return [], notes
    value = ", ".join(f"{quoted(key)} = {quoted(quoted_channel(name))}" for key, name in slow.items())
    return [ProposalLine("columns", "# covariates", f"{{{value}}}", message("init.covariates"))], notes


@with_one_blas_thread
def init(
    path: Source | Sequence[Source],
    columns: Columns | str | None = None,
    *,
    where: Mapping[str, str] | None = None,
    kind: str | None = None,
) -> LoopProposal:
    """Propose a loop from logs: columns, units, sample rate, plant, cutoff and memory, each with its evidence.

    Parameters
    ----------
    path
        The log, or several of one machine: paths, frames, or arrays by name.
    columns
        The columns, or what is known of them, as ``"u=cur"``: the others are guessed by the words and units in their
        names.
    where
        Rows to take, as for `read`.
    kind
        Kind of the plant, where it is known: ``"axis"``, ``"cylinder"`` or ``"polynomial"``.

    Returns
    -------
    LoopProposal
        ``.loop``, ``.lines`` with reasons, ``.candidates``, ``.notes``; `print` shows the loop file, ``.save(path)``
        writes it.

    Raises RecordingError if the log cannot be read, nothing moves in it, or no name suggests u or y.

    Examples
    --------
    >>> ss.init("monday.csv").loop.sample_rate
    200.0
    """
    sources = [path] if isinstance(path, str | Path | Mapping) or is_frame(path) else [*path]
    with read_part(PART_ROWS) as part, TemporaryDirectory() as folder:
        paths = []
        for k, log in enumerate(sources):
            own = Path(folder) / str(k)
            own.mkdir()
            paths.append(Path(log) if isinstance(log, str | Path) else write_source(log, own))
        if not isinstance(columns, Columns):
            columns = propose_columns(paths[0], list_channels(paths[0]), given=columns)
        proposal = propose_loop(paths, columns, where, kind=kind)
    cut = (message("init.part", log=name, rows=rows) for name, rows in part.cut.items())
    return replace(proposal, notes=(*proposal.notes, *cut))


def _unwrapped_columns(
    path: Path, columns: Columns, where: Mapping[str, str] | None
) -> tuple[Columns, dict[str, float]]:
    """Return the columns with those unwrapped that wrap, and the ranges in which the keys concerned do."""
    opened = open_file(path, columns.text)
    plain: dict[str, LinearCombination] = {}
    for key, text in (("reference", columns.reference), ("input", columns.input), ("output", columns.outputs[0])):
        try:
            combination = parse_combination(text, opened.known, path.name)
        except ServoscopeError:  # the reference may be missing; what else is wrong is told when the log is read
            continue
        if len(combination.factors) == 1 and not combination.constant and not combination.wraps:
            plain[key] = combination
    if len(columns.outputs) > 1:
        plain.pop("output", None)
    values = chosen_values(opened, [name for combination in plain.values() for name in combination.factors], where)
    changes, wraps = {}, {}
    for key, linear_combination in plain.items():
        ((name, factor),) = linear_combination.factors.items()
        if (period := find_wrap(values[name])) is not None:
            text = f"{quoted_channel(name)} % {period:.16g}"
            changes[key] = text if factor == 1.0 else f"{factor:.15g} * ({text})"
            wraps[key] = period
    return columns.model_copy(update=changes), wraps


def _column_lines(path: Path, columns: Columns, wraps: Mapping[str, float], recording: Recording) -> list[ProposalLine]:
    lines = list[ProposalLine]()
    if columns.time is not None:
        told = message("init.time_unit"), False
        if _counts_seconds(columns, recording):  # a counter, or another unit, that nobody names
            told = message("init.time_counts", step=1.0 / recording.sample_rate), True
        why = message("init.row_rate" if columns.row_rate else "init.column")
        lines = [ProposalLine("columns", "time", quoted(columns.time), why)]
        lines += [ProposalLine("columns", "time_unit", quoted(columns.time_unit), *told)] * (columns.row_rate is None)
    without = columns.reference == Columns().reference and columns.reference not in open_file(path, columns.text).known
    spans = [float(np.ptp(x[np.isfinite(x)])) for x in (recording.r, recording.y)]
    for key, texts in (("reference", (columns.reference,)), ("input", (columns.input,)), ("output", columns.outputs)):
        unit = split_unit(texts[0].rpartition("* ")[2].strip("`"))[1]
        why = message("init.column_unit", unit=unit) if unit else message("init.column_plain")
        value = quoted(texts[0]) if len(texts) == 1 else f"[{', '.join(map(quoted, texts))}]"
        if key in wraps:
            why = message("init.wraps", range=wraps[key])
        doubtful = (not unit and key == "output") or key in wraps
        if key == "reference" and without:
            why, doubtful = message("init.no_reference"), True
        elif key == "input" and texts[0].startswith("-"):
            why, doubtful = message("init.turned"), True
        elif key == "reference" and not 1.0 / MAX_SPAN_RATIO < spans[0] / (spans[1] or math.inf) < MAX_SPAN_RATIO:
            why, doubtful = message("init.reference_unit", r=spans[0], y=spans[1]), True
        lines.append(ProposalLine("columns", key, value, why, doubtful))
    if columns.resample:
        how = next(defect.text for defect in recording.defects if defect.kind == "resampled")
        lines.append(ProposalLine("columns", "resample", "true", message("init.resample", how=how)))
    if columns.text is not None:
        given = columns.text.model_dump(exclude_defaults=True)
        value = ", ".join(f"{key} = {json.dumps(setting, ensure_ascii=False)}" for key, setting in given.items())
        lines.append(ProposalLine("columns", "text", f"{{{value}}}", message("init.layout")))
    return lines


def _counts_seconds(columns: Columns, recording: Recording) -> bool:
    """Tell whether the clock is one of whole numbers without a unit, at most one a second."""
    plain = columns.time_unit == "s" and not split_unit(columns.time or "")[1] and recording.began is None
    return plain and recording.sample_rate <= 1.0 and not np.any(recording.t % 1.0)
