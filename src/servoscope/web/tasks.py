"""What jobs do, in processes of their own: they read what was sent, call the rooms of servoscope, and write results."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from servoscope import inspection, monitor, points, readers, summaries
from servoscope.baseline import Baseline
from servoscope.design import design_study
from servoscope.diagnosis import Trace
from servoscope.errors import LoopError, RecordingError
from servoscope.loop import Columns, Loop
from servoscope.recording import Recording
from servoscope.settings import parsed
from servoscope.web.guessing import mapping
from servoscope.web.signals import chosen, plain

__all__ = ["TASKS", "loop_of"]

Plain = dict[str, Any]
Tell = Callable[[str], None]

ROWS = 20  # of a preview
CELL = 100  # characters of one of its cells
SIGNAL_POINTS, TRACE_POINTS = 2000, 1000


def look(tell: Tell, file: str) -> Plain:
    """Say which columns a file has, and show its first rows."""
    from servoscope.readers.opening import open_file

    tell("columns")
    found = summaries.channels(file, readers.channels(file))["channels"]
    assert isinstance(found, list), "one entry per column"
    names = [channel["name"] for channel in found]
    opened, rows, first = open_file(file), 0, None
    for table in opened.pieces(opened.columns):
        rows += table.rows
        first = first if first is not None else table
    assert first is not None, "a file without rows was refused"
    head = [[_cell(x) for x in first.columns[name].slice(0, ROWS).to_pylist()] for name in names]
    preview = {"columns": names, "rows": [list(row) for row in zip(*head, strict=True)]}
    return {"rows": rows, "columns": found, "preview": preview, "mapping": mapping(found)}


def _cell(value: Any) -> float | str | None:
    if isinstance(value, bool | int | float):
        return float(value) if math.isfinite(value) else None
    return None if value is None else str(value)[:CELL]


def inspect(tell: Tell, file: str, loop: Plain | None, columns: Plain | None, **rows: Any) -> Plain:
    """Say whether a recording is usable, and if not, why."""
    settings = loop_of(loop) if loop is not None else None
    recording = read(file, settings, columns, **rows)
    tell("inspecting")
    said = inspection.inspect(recording, settings)
    spectra = said.traces.spectra if said.traces is not None else None
    told = None
    if spectra is not None:
        of = {"frequency_hz": spectra.f, "u": spectra.U, "y": spectra.Y}
        of |= {"coherence_u": spectra.coherence_u, "coherence_y": spectra.coherence_y}
        told = {name: plain(values) for name, values in of.items()}
    return {"inspection": summaries.plain(said), "signals": _signals(recording), "spectra": told}


def diagnose(
    tell: Tell,
    file: str,
    baseline: str,
    name: str,
    point: str | None,
    columns: Plain | None,
    out: str,
    **rows: Any,
) -> Plain:
    """Diagnose a recording; document, trace and report go into the folder `out`."""
    from servoscope import report

    healthy = Baseline.load(baseline)
    healthy = healthy.at(point) if point is not None else healthy
    recording = read(file, healthy.loop, columns, **rows)
    tell("recursion")
    said, course = monitor.examine(healthy, recording, tell)
    tell("report")
    judged = healthy.at(said.point) if said.point else healthy
    origin = summaries.provenance(judged, Path(name), Path(file))
    report.write(Path(out) / "report.html", said, course, recording, judged.loop, origin)
    plant = judged.loop.plant
    everything = {
        "document": summaries.plain(said),
        "words": {fault.name: fault.words for fault in plant.faults},
        "units": list(plant.units),
        "signals": _signals(recording),
        "trace": _trace(course, plant.coefficient_units),
    }
    (Path(out) / "data.json").write_text(json.dumps(everything, allow_nan=False), encoding="utf-8")
    kept = {"verdict": said.verdict, "summary": said.summary, "recording": said.recording}
    return {**kept, "hash": judged.hash}


def learn(
    tell: Tell,
    recordings: list[Plain],
    loop: Plain,
    columns: Plain | None,
    where: dict[str, str],
    compare: str | None,
    accept_change: bool,
    out: str,
) -> Plain:
    """Learn a baseline from healthy recordings into the folder `out`, and inspect each of them."""
    settings = loop_of(loop)
    if columns is not None:
        settings = settings.model_copy(update={"columns": _columns(columns, settings)})
    chosen_: dict[str, list[Recording]] = {}
    told = []
    for one in recordings:
        tell(f"reading {Path(one['file']).name}")
        recording = read(one["file"], settings, None, where)
        chosen_.setdefault(one["point"] or "", []).append(recording)
        told.append({**one["said"], "inspection": summaries.plain(inspection.inspect(recording, settings))})
    if "" in chosen_ and len(chosen_) > 1:
        raise RecordingError("name the operating point of each recording, or of none")
    earlier = Baseline.load(compare) if compare is not None else None
    found = points.learn(settings, chosen_.get("", chosen_), tell, compare=earlier, accept_change=accept_change)
    found.save(Path(out) / "baseline.json")
    return {"summary": summaries.finite(summaries.baseline(found)), "recordings": told}


def design(tell: Tell, loop: Plain, files: list[str], columns: Plain | None, out: str, **how: Any) -> Plain:
    """Study what can be detected and told apart; study and page go into the folder `out`."""
    from servoscope.report import studies

    settings = loop_of(loop)
    recordings = [read(file, settings, columns) for file in files]
    study = design_study(settings, recordings, progress=tell, **how)
    studies.write(Path(out) / "report.html", study)
    (Path(out) / "study.json").write_text(json.dumps(summaries.plain(study), allow_nan=False), encoding="utf-8")
    return {"loop": study.loop, "reference": study.reference}


def loop_of(ref: Mapping[str, str]) -> Loop:
    """Return a loop from the text of its file, a baseline's file, or the name of an example.

    Raises
    ------
    LoopError
        If it is none.
    """
    if "baseline" in ref:
        return Baseline.load(ref["baseline"]).loop
    name, text = "loop", ref.get("toml", "")
    if "example" in ref:
        name = f"{ref['example']}.toml"
        text = files("servoscope.examples").joinpath(name).read_text(encoding="utf-8")
    return Loop.from_dict(parsed(text, name, LoopError), name)


def read(
    file: str,
    loop: Loop | None,
    columns: Plain | None,
    where: Mapping[str, str] | None = None,
    from_s: float | None = None,
    to_s: float | None = None,
) -> Recording:
    """Read an upload; columns that are not said stay as in the loop."""
    chosen_ = _columns(columns, loop) if columns is not None else None
    if loop is None and chosen_ is None:
        lacking = {"t", "r", "u", "y"} - {channel.name for channel in readers.channels(file)}
        if lacking:
            raise RecordingError(
                f"{Path(file).name}: has no column {min(lacking)}: say which columns are t, r, u and y"
            )
    recording = readers.read(file, loop, columns=chosen_, where=where or {})
    if from_s is None and to_s is None:
        return recording
    return recording.part(-math.inf if from_s is None else from_s, math.inf if to_s is None else to_s)


def _columns(said: Plain, loop: Loop | None) -> Columns:
    base = loop.columns if loop is not None else Columns()
    return Columns.model_validate({**base.model_dump(), **said})


def _signals(recording: Recording) -> Plain:
    signals = recording.r, recording.u, recording.y
    at = chosen(signals, SIGNAL_POINTS)
    columns = {name: plain(signal[at]) for name, signal in zip("ruy", signals, strict=True)}
    return {"t": plain(recording.t[at]), **columns}


def _trace(course: Trace, units: tuple[str, ...]) -> Plain:
    excess = np.where(course.ready, course.statistic / course.threshold, np.nan)
    at = chosen((excess, course.level), TRACE_POINTS)
    std = np.sqrt(np.maximum(np.diagonal(course.covariance, axis1=1, axis2=2), 0.0))
    H, healthy = course.ifrf.H[at], course.ifrf_expected.H[at]
    return {
        "t": plain(course.t[at]),
        "statistic": plain(excess[at]),
        "level": plain(course.level[at]),
        "responses": [
            {
                "frequency_hz": float(f),
                "real": plain(H[:, i].real),
                "imag": plain(H[:, i].imag),
                "nominal_real": plain(healthy[:, i].real),
                "nominal_imag": plain(healthy[:, i].imag),
            }
            for i, f in enumerate(course.ifrf.frequencies)
        ],
        "parameters": [
            {
                "name": name,
                "unit": units[i] if i < len(units) else "",
                "value": plain(course.theta[at, i]),
                "std": plain(std[at, i]),
                "nominal": plain(course.expected[at, i]),
            }
            for i, name in enumerate(course.names)
        ],
    }


TASKS: dict[str, Callable[..., Plain]] = {
    "look": look,
    "inspect": inspect,
    "diagnose": diagnose,
    "learn": learn,
    "design": design,
}
