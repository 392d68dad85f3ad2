"""An asset's baseline after a repair or a healthy stretch: how far it is, a preview, what is put in force, and back."""

from __future__ import annotations

import asyncio
from functools import partial

from fastapi import APIRouter, HTTPException

from servoscope.baseline.baseline import Baseline
from servoscope.baseline.history import history_folder
from servoscope.machines.kinds import load_cached
from servoscope.service import renewal
from servoscope.service.assets.status import AssetStatus
from servoscope.service.config import ServiceFile
from servoscope.web.dependencies import VIEWER, Context, ContextDep, Engineer
from servoscope.web.jobs.queue import Job
from servoscope.web.routes.assets import find_asset
from servoscope.web.routes.baselines import load_loop_baseline
from servoscope.web.schemas import responses
from servoscope.web.schemas.requests import RelearningRequest, TakeRequest

router = APIRouter(tags=["assets"], dependencies=[VIEWER])


def _find_config(context: Context, asset: str) -> tuple[ServiceFile, AssetStatus]:
    _, status = find_asset(context, asset)
    if context.config is None or asset not in context.config.assets:
        raise HTTPException(404, f"no service file is known that has an asset {asset}")
    return context.config, status


def _progress(context: Context, config: ServiceFile, asset: str, status: AssetStatus) -> responses.RelearningState:
    baseline = load_loop_baseline(config.baseline_file(asset))
    progress = renewal.learning_progress(config, context.store, asset, status, baseline)
    point = config.assets[asset].point
    offers = renewal.offers(baseline.at(point) if point else baseline, status, config.diagnosis.kept_s)
    return responses.RelearningState(**dict(progress), offers=offers)


@router.get("/assets/{asset}/relearning")
def get_progress(context: ContextDep, asset: str) -> responses.RelearningState | None:
    """Return how far it is in learning after what was noted; null where no service file is known."""
    (_, status), config = find_asset(context, asset), context.config
    if config is None or asset not in config.assets:
        return None
    if load_cached(config.baseline_file(asset)).loop_baseline is None:
        return None  # what it learns from are whole logs of several days
    return _progress(context, config, asset, status)


@router.post("/assets/{asset}/relearnings", status_code=202)
async def start_preview(
    context: ContextDep, who: Engineer, asset: str, request: RelearningRequest
) -> responses.JobResponse:
    """Learn its baseline anew from the samples that the store keeps; a job. Nothing is put in force."""
    config, _ = await asyncio.to_thread(_find_config, context, asset)
    path, point = config.baseline_file(asset), config.assets[asset].point or ""
    before = await asyncio.to_thread(load_loop_baseline, path)
    stretch = await asyncio.to_thread(
        renewal.stored_stretch, config, context.store, asset, before, request.since, request.until
    )
    id_, out = await asyncio.to_thread(context.storage.create, "learnings")
    file = await asyncio.to_thread(renewal.write_stretch, out, stretch)

    def finish(result: responses.JsonObject) -> responses.JsonObject:
        learned = Baseline.load(out / "baseline.json")
        judged = renewal.judge_again(context.store, asset, before, learned, find_asset(context, asset)[1].position.t)
        context.storage.publish(responses.LearningRow(id=id_, who=who.user, uploads=[asset, file.name]))
        return {"learning": id_, "judged": judged._asdict(), **result}

    sources = [path.parent / source.name for baseline in before.per_point for source in baseline.sources]
    reads = [str(place) for place in (path, history_folder(path), *sources) if place.exists()]
    arguments = str(path), str(file), request, point, who.user, str(out)
    discard = partial(context.storage.remove, "learnings", id_)
    return context.jobs.submit(
        Job("relearning", who.user, "relearn_baseline", arguments, out, reads, out, finish, discard)
    )


@router.post("/assets/{asset}/baseline")
def put_in_force(context: ContextDep, who: Engineer, asset: str, request: TakeRequest) -> responses.RelearningState:
    """Put the baseline of a preview in force, or go one step back; the earlier one is kept."""
    config, status = _find_config(context, asset)
    if request.learning is None:
        renewal.go_back(config, context.store, asset, who.user, request.why, status.position.t)
        return _progress(context, config, asset, status)
    record = context.storage.read(responses.LearningRow, request.learning)
    if record.uploads[:1] != [asset]:
        raise HTTPException(404, f"there is no preview {request.learning} of {asset}")
    folder = context.storage.path(responses.LearningRow, request.learning)
    learned = Baseline.load(folder / "baseline.json")
    stretch = renewal.read_stretch(folder / record.uploads[1], learned)
    renewal.put_in_force(config, context.store, asset, learned, stretch, status.position.t)
    return _progress(context, config, asset, status)
