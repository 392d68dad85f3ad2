"""Baselines: those of the service file and those that were saved here; the loops that come with them; learning."""

from __future__ import annotations

import asyncio
import shutil
from dataclasses import dataclass
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any

from fastapi import APIRouter, HTTPException, Response
from fastapi.responses import FileResponse

from servoscope.baseline.baseline import Baseline
from servoscope.machines.kinds import load_cached
from servoscope.machines.protocol import Machine
from servoscope.machines.servo_loop import LoopMachine
from servoscope.models.loop import Loop
from servoscope.report import plain_values
from servoscope.web.dependencies import VIEWER, Context, ContextDep, Engineer
from servoscope.web.jobs.queue import Job
from servoscope.web.schemas import responses
from servoscope.web.schemas.assets import signal_units
from servoscope.web.schemas.requests import BaselineRequest, LearningRequest, LoopRef

router = APIRouter(tags=["baselines"], dependencies=[VIEWER])

SERVICE_PREFIX = "service:"
EXAMPLES = ("reference-rig",)
JSON_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {"content": {"application/json": {"schema": {"type": "object"}}}, "description": "The file"}
}


@dataclass(frozen=True)
class BaselineFile:
    """A baseline's file, and its row in lists."""

    path: Path
    row: responses.BaselineRow


def asset_baseline_id(context: Context, asset: str) -> str | None:
    """Return the id of the baseline that an asset is compared with; None where no service file is known."""
    config = context.config
    if config is None or asset not in config.assets:
        return None
    path = config.baseline_file(asset)
    if path == config.relearned_file(asset):
        return SERVICE_PREFIX + asset
    file = config.assets[asset].baseline
    names = (name for name, settings in config.assets.items() if settings.baseline == file)
    return SERVICE_PREFIX + next(name for name in names if config.baseline_file(name) == path)


def find_baseline(context: Context, id_: str) -> BaselineFile:
    """Return a baseline.

    Raises HTTPException 404 if there is none; raises BaselineError if its file cannot be used.
    """
    if not id_.startswith(SERVICE_PREFIX):
        return _saved_baseline(context, context.storage.read(responses.BaselineRecord, id_))
    # also of an asset that has shared another one's baseline meanwhile: an address is for good
    config, asset = context.config, id_.removeprefix(SERVICE_PREFIX)
    if config is None or asset not in config.assets:
        raise HTTPException(404, f"there is no baseline {id_}")
    path, file = config.baseline_file(asset), config.assets[asset].baseline
    alike = [name for name, settings in config.assets.items() if settings.baseline == file]
    sharing = [name for name in alike if config.baseline_file(name) == path]
    facts = _baseline_facts(load_cached(path))
    return BaselineFile(
        path, responses.BaselineRow(id=id_, name=path.name, origin="service", assets=sharing, **dict(facts))
    )


def _saved_baseline(context: Context, record: responses.BaselineRecord) -> BaselineFile:
    path = context.storage.path(responses.BaselineRecord, record.id) / "baseline.json"
    return BaselineFile(path, responses.BaselineRow(name=record.id, origin="saved", **dict(record)))


def _baseline_facts(machine: Machine) -> responses.BaselineFacts:
    return responses.BaselineFacts(
        loop=machine.name,
        hash=machine.hash,
        points=list(machine.points),
        columns=machine.carrier.columns.model_dump(mode="json"),
        units=signal_units(machine.units) if machine.units is not None else None,
        recordings=len(machine.sources),
        duration_s=sum(source.duration_s for source in machine.sources),
    )


def load_loop_baseline(path: Path) -> Baseline:
    """Return the baseline of a loop in a file; raises BaselineError if it is of another machine."""
    return load_cached(path).loop_baseline or Baseline.load(path)


def resolve_loop(context: Context, ref: LoopRef) -> LoopRef:
    """Return a loop as a task reads it."""
    if ref.baseline is None:
        return ref
    return ref.model_copy(update={"baseline": str(find_baseline(context, ref.baseline).path)})


def _list_files(context: Context) -> list[BaselineFile]:
    config = context.config
    ids = dict.fromkeys(asset_baseline_id(context, name) for name in config.assets) if config is not None else {}
    of_service = [find_baseline(context, id_) for id_ in ids if id_ is not None]
    return of_service + [_saved_baseline(context, record) for record in context.storage.list(responses.BaselineRecord)]


@router.get("/baselines")
def list_baselines(context: ContextDep) -> responses.BaselineList:
    """List the baselines."""
    return responses.BaselineList(baselines=[baseline_file.row for baseline_file in _list_files(context)])


@router.get("/baselines/{id}")
def get_baseline(context: ContextDep, id: str) -> responses.BaselineDetail:
    """Return a baseline: what was learned, and which faults it can detect."""
    baseline_file = find_baseline(context, id)
    summary: Any = load_cached(baseline_file.path).summary()
    return responses.BaselineDetail(**dict(baseline_file.row), summary=plain_values.replace_nan(summary))


@router.get("/baselines/{id}/file", response_class=Response, responses=JSON_RESPONSES)
def download_baseline(context: ContextDep, id: str) -> Response:
    """Return its file, for `servoscope diagnose`."""
    baseline = find_baseline(context, id)
    load_cached(baseline.path)
    name = f"{baseline.row.name.removesuffix('.json')}.json"
    return FileResponse(baseline.path, media_type="application/json", filename=name)


@router.delete("/baselines/{id}", status_code=204)
def delete_baseline(context: ContextDep, who: Engineer, id: str) -> None:
    """Delete a baseline that was saved here."""
    if id.startswith(SERVICE_PREFIX):
        raise HTTPException(409, f"{id} belongs to the service file")
    record = context.storage.read(responses.BaselineRecord, id)
    context.store.add_audit(who.user, "", "baseline deleted", {"baseline": id, "hash": record.hash})
    context.storage.remove("baselines", id)


@router.get("/loops")
def list_loops(context: ContextDep) -> responses.LoopList:
    """List the loops that come with the program, and those of the baselines."""
    rows = []
    for name in EXAMPLES:
        text = files("servoscope.simulation").joinpath(f"{name}.toml").read_text(encoding="utf-8")
        rows.append(_loop_row({"example": name}, Loop.from_text(text, f"{name}.toml"), text))
    learned = ((file.row.id, load_cached(file.path).loop_baseline) for file in _list_files(context))
    rows += [_loop_row({"baseline": id_}, baseline.loop, None) for id_, baseline in learned if baseline is not None]
    return responses.LoopList(loops=rows)


def _loop_row(ref: dict[str, str], loop: Loop, toml: str | None) -> responses.LoopRow:
    return responses.LoopRow(
        ref=ref,
        name=loop.name,
        plant=loop.plant.kind,
        sample_rate_hz=loop.sample_rate,
        controller=loop.controller is not None,
        columns=loop.columns.model_dump(mode="json"),
        units=signal_units(loop.plant.units),
        toml=toml,
    )


@router.post("/learnings", status_code=202)
async def start_learning(context: ContextDep, who: Engineer, request: LearningRequest) -> responses.JobResponse:
    """Learn from healthy uploads, and inspect each of them; a job. Its baseline waits to be saved."""
    uploads = [recording.upload for recording in request.recordings]
    paths = await asyncio.to_thread(context.storage.upload_paths, uploads)
    loop = await asyncio.to_thread(resolve_loop, context, request.loop)

    async def file(baseline: str) -> str:
        return str((await asyncio.to_thread(find_baseline, context, baseline)).path)

    earlier = await file(request.compare) if request.compare is not None else None
    alike = [await file(baseline) for baseline in request.population]
    id_, out = await asyncio.to_thread(context.storage.create, "learnings")

    def finish(result: responses.JsonObject) -> responses.JsonObject:
        context.storage.publish(responses.LearningRow(id=id_, who=who.user, uploads=uploads))
        return {"learning": id_, **result}

    arguments = request, loop, paths, earlier, alike, str(out)
    discard = partial(context.storage.remove, "learnings", id_)
    reads = (*loop.files, *paths, *alike, *([earlier] if earlier is not None else []))
    return context.jobs.submit(Job("learning", who.user, "learn_baseline", arguments, out, reads, out, finish, discard))


@router.post("/baselines", status_code=201)
def save_baseline(context: ContextDep, who: Engineer, request: BaselineRequest) -> responses.BaselineRow:
    """Save a learned baseline under a name."""
    learned = context.storage.path(responses.LearningRow, request.learning) / "baseline.json"
    facts = _baseline_facts(LoopMachine.load(learned))
    id_, folder = context.storage.create("baselines", request.name)
    try:
        shutil.copyfile(learned, folder / "baseline.json")
        context.store.add_audit(who.user, "", "baseline saved", {"baseline": id_, "hash": facts.hash})
        record = context.storage.publish(responses.BaselineRecord(id=id_, who=who.user, **dict(facts)))
    except BaseException:
        context.storage.remove("baselines", id_)
        raise
    return _saved_baseline(context, record).row
