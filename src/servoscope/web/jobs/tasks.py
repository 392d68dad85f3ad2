"""What jobs do, in processes of their own: they read what was sent, call other packages, and write results.

Each task is a function that a worker calls with a callback for its progress; its result is written as JSON.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from servoscope.assessment.assess import assess
from servoscope.baseline.baseline import Baseline
from servoscope.baseline.comparison import compare_baselines
from servoscope.core.errors import RecordingError
from servoscope.core.workers import Progress
from servoscope.design import design_study
from servoscope.diagnosis import operating_points
from servoscope.diagnosis.relearn import relearn
from servoscope.learning import inspection
from servoscope.learning.proposal import init
from servoscope.machines.kinds import load_machine
from servoscope.machines.protocol import Machine
from servoscope.machines.servo_loop import recording_columns
from servoscope.models.loop import Columns, Loop
from servoscope.report import plain_values
from servoscope.report.downsample import json_numbers
from servoscope.service.renewal import read_stretch
from servoscope.signals import Recording, readers
from servoscope.signals.readers.axes import moving_axes, signals_of_one_axis
from servoscope.signals.readers.formats import open_file
from servoscope.signals.readers.guess_columns import guess_mapping
from servoscope.signals.readers.tags import find_loops
from servoscope.simulation.measurement import NOISE_U_STD, NOISE_Y_STD
from servoscope.web.schemas import requests
from servoscope.web.schemas.responses import JsonObject

PREVIEW_ROWS = 20
PREVIEW_CELL = 100  # characters
PREVIEW_CELLS = 10_000
MAX_COLUMNS, MAX_NAME_CHARS = 2000, 100_000  # of a file; characters of all names together
SIGNAL_POINTS, TRACE_POINTS = 2000, 1000


def preview_file(progress: Progress, file: str) -> JsonObject:
    """Return the columns of a file, what they may mean, and its first rows."""
    progress("columns")
    opened, count, first = open_file(file), 0, None
    _check_width(file, opened.columns)
    listed = readers.list_channels(file)
    channels: Any = plain_values.channels_summary(file, listed)["channels"]
    names = [str(channel["name"]) for channel in channels]
    most = max(1, min(PREVIEW_ROWS, PREVIEW_CELLS // len(names)))
    for table in opened.iter_chunks(opened.columns):
        count += table.rows
        first = first if first is not None else table
    assert first is not None, "a file without rows was refused"
    head = [[_preview_cell(x) for x in first.columns[name].slice(0, most).to_pylist()] for name in names]
    signals = signals_of_one_axis(listed)
    return {
        "rows": count,
        "columns": channels,
        "preview": {"columns": names, "rows": list(zip(*head, strict=True))},
        "mapping": guess_mapping(signals),
        "axes": {axis: guess_mapping(columns) for axis, columns in moving_axes(listed).items()},
    }


def _check_width(file: str, names: Sequence[str]) -> None:
    """Refuse a file whose preview would be large, because all columns are in it."""
    if len(names) > MAX_COLUMNS:
        raise RecordingError(
            f"{file}: holds {len(names)} columns, more than {MAX_COLUMNS}: leave out what is not needed"
        )
    if sum(map(len, names)) > MAX_NAME_CHARS:
        raise RecordingError(f"{file}: the names of its columns are longer than {MAX_NAME_CHARS} characters together")


def _preview_cell(value: Any) -> float | str | None:
    if isinstance(value, bool | int | float):
        return float(value) if math.isfinite(value) else None
    return None if value is None else str(value)[:PREVIEW_CELL]


def inspect_file(
    progress: Progress, file: str, request: requests.InspectionRequest, loop: requests.LoopRef | None
) -> JsonObject:
    """Return whether a recording is usable, and if not, why."""
    settings = load_loop(loop) if loop is not None else None
    recording = read_recording(file, settings, request)
    progress("inspecting")
    return _inspection_result(inspection.inspect(recording, settings), recording)


def assess_file(progress: Progress, file: str, request: requests.InspectionRequest) -> JsonObject:
    """Return what one log of a loop shows without a baseline; of several loops of the first."""
    loops = find_loops(open_file(file).columns)
    columns = _merge_columns(request.columns, None) if request.columns is not None else next(iter(loops.values()))
    first = -math.inf if request.from_s is None else request.from_s
    last = math.inf if request.to_s is None else request.to_s
    ((name, samples),) = readers.read_rows(file, columns, request.where, span=(first, last)).items()
    progress("assessing")
    result = assess(samples, name=name)
    return {"assessment": plain_values.to_plain_values(result)}


def propose_file(progress: Progress, file: str, request: requests.ProposalRequest) -> JsonObject:
    """Propose a loop file for a recording as `servoscope init` does, and inspect the recording with it."""
    progress("proposing")
    columns = _merge_columns(request.columns, None) if request.columns is not None else None
    proposal = init(file, columns)
    recording = readers.read(file, proposal.loop)
    lines = [
        {"section": line.section, "key": line.key, "value": line.value, "why": str(line.why), "doubtful": line.doubtful}
        for line in proposal.lines
    ]
    inspected = _inspection_result(inspection.inspect(recording, proposal.loop), recording)
    return {"toml": proposal.to_toml(), "lines": lines, **inspected}


def _inspection_result(result: inspection.Inspection, recording: Recording) -> JsonObject:
    spectra = result.traces.spectra if result.traces is not None else None
    columns = None
    if spectra is not None:
        columns = {"frequency_hz": spectra.f, "u": spectra.U, "y": spectra.Y}
        columns |= {"coherence_u": spectra.coherence_u, "coherence_y": spectra.coherence_y}
    return {
        "inspection": plain_values.to_plain_values(result),
        "signals": recording_columns(recording),
        "spectra": {name: json_numbers(values) for name, values in columns.items()} if columns is not None else None,
    }


def diagnose_file(
    progress: Progress, file: str, request: requests.DiagnosisRequest, baseline_file: str, name: str, out: str
) -> JsonObject:
    """Diagnose a recording with a baseline, for users `name`; data and report go into the folder `out`."""
    machine = load_machine(baseline_file)
    machine = machine.at(request.point) if request.point is not None else machine
    judged = machine.judge(_read_selection(machine, file, request), progress)
    progress("report")
    judged.write_report(Path(out) / "report.html", name, file)
    diagnosis = judged.diagnosis
    data = {"document": diagnosis.model_dump(mode="json"), **judged.data}
    text = json.dumps(plain_values.replace_nan(data), allow_nan=False)
    (Path(out) / "data.json").write_text(text, encoding="utf-8")
    kept = {"verdict": diagnosis.verdict, "summary": str(diagnosis.summary), "recording": diagnosis.recording}
    return {**kept, "hash": judged.hash}


def _read_selection(machine: Machine, file: str, request: requests.DiagnosisRequest) -> Any:
    """Return what was asked for of a log; only those of loops have parts."""
    if machine.loop_baseline is not None:
        return read_recording(file, machine.carrier, request)
    refused = [key for key in ("where", "from_s", "to_s") if getattr(request, key) not in (None, {})]
    if refused:
        raise RecordingError(f"{', '.join(refused)}: leave out, a log of kind {machine.kind!r} is diagnosed as a whole")
    return machine.read(file)


def learn_baseline(
    progress: Progress,
    request: requests.LearningRequest,
    loop: requests.LoopRef,
    uploads: Sequence[str],
    earlier: str | None,
    alike: Sequence[str],
    out: str,
) -> JsonObject:
    """Learn a baseline from healthy recordings into the folder `out`, and inspect each of them."""
    settings = load_loop(loop)
    if request.columns is not None:
        settings = settings.model_copy(update={"columns": _merge_columns(request.columns, settings)})
    by_point: dict[str, list[Recording]] = {}
    rows = []
    for asked, file in zip(request.recordings, map(Path, uploads), strict=True):
        progress(f"reading {file.name}")
        recording = read_recording(str(file), settings, requests.RecordingSelection(where=request.where))
        by_point.setdefault(asked.point or "", []).append(recording)
        result = plain_values.to_plain_values(inspection.inspect(recording, settings))
        rows.append({"upload": asked.upload, "name": file.name, "point": asked.point, "inspection": result})
    if "" in by_point and len(by_point) > 1:
        raise RecordingError("name the operating point of each recording, or of none")
    baseline = operating_points.learn(
        settings,
        by_point.get("", by_point),
        progress,
        compare=Baseline.load(earlier) if earlier is not None else None,
        accept_change=request.accept_change,
        population=alike,
    )
    baseline.save(Path(out) / "baseline.json")
    return {"summary": plain_values.replace_nan(plain_values.baseline_summary(baseline)), "recordings": rows}


def relearn_baseline(
    progress: Progress,
    baseline_file: str,
    stretch: str,
    request: requests.RelearningRequest,
    point: str,
    who: str,
    out: str,
) -> JsonObject:
    """Learn a baseline anew with samples of the store into the folder `out`, and say what differs."""
    before = Baseline.load(baseline_file)
    recording = read_stretch(Path(stretch), before)
    learned = relearn(
        baseline_file,
        {point: [recording]},
        progress,
        after=request.after,
        who=who,
        why=request.why,
        accept_change=request.accept_change,
        folders=[Path(stretch).parent],
        leave_out=True,
        save=False,
    )
    learned.save(Path(out) / "baseline.json")
    points = [difference.to_dict() for difference in compare_baselines(before, learned)]
    return {"points": points, "notes": [str(note) for note in learned.notes], "duration_s": recording.duration_s}


def study_design(
    progress: Progress, request: requests.DesignRequest, loop: requests.LoopRef, uploads: Sequence[str], out: str
) -> JsonObject:
    """Study which faults can be detected and isolated; study and page go into the folder `out`."""
    from servoscope.report import design_page

    settings, selection = load_loop(loop), requests.RecordingSelection(columns=request.columns)
    study = design_study(
        settings,
        [read_recording(file, settings, selection) for file in uploads],
        progress=progress,
        reference=request.reference,
        after_s=request.after_s,
        noise_u_std=request.noise_u_std if request.noise_u_std is not None else NOISE_U_STD,
        noise_y_std=request.noise_y_std if request.noise_y_std is not None else NOISE_Y_STD,
    )
    design_page.write_design_page(Path(out) / "report.html", study)
    text = json.dumps(plain_values.to_plain_values(study), allow_nan=False)
    (Path(out) / "study.json").write_text(text, encoding="utf-8")
    return {"loop": study.loop, "reference": str(study.reference)}


def load_loop(ref: requests.LoopRef) -> Loop:
    """Return a loop; raises LoopError if it is none."""
    if ref.baseline is not None:
        return Baseline.load(ref.baseline).loop
    name, text = "loop", ref.toml or ""
    if ref.example is not None:
        name = f"{ref.example}.toml"
        text = files("servoscope.simulation").joinpath(name).read_text(encoding="utf-8")
    return Loop.from_text(text, name)


def read_recording(file: str, loop: Loop | None, selection: requests.RecordingSelection) -> Recording:
    """Return the selected part of a file; columns that the selection leaves out stay as in the loop."""
    columns = _merge_columns(selection.columns, loop) if selection.columns is not None else None
    if loop is None and columns is None:
        missing = {"t", "r", "u", "y"} - {channel.name for channel in readers.list_channels(file)}
        if missing:
            raise RecordingError(
                f"{Path(file).name}: has no column {min(missing)}: say which columns are t, r, u and y"
            )
    recording = readers.read(file, loop, columns=columns, where=selection.where)
    first, last = selection.from_s, selection.to_s
    if first is None and last is None:
        return recording
    return recording.part(-math.inf if first is None else first, math.inf if last is None else last)


def _merge_columns(mapping: requests.ColumnMapping, loop: Loop | None) -> Columns:
    base = loop.columns if loop is not None else Columns()
    return Columns.model_validate({**base.model_dump(), **mapping.to_update()})
