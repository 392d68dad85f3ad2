"""Baselines: those of the service file and those that were saved here; the loops that come with them; learning."""

from __future__ import annotations

import asyncio
import shutil
import tomllib
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from fastapi import APIRouter
from fastapi.responses import FileResponse
from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.status import HTTP_201_CREATED, HTTP_202_ACCEPTED, HTTP_204_NO_CONTENT

from servoscope import summaries
from servoscope.baseline import Baseline
from servoscope.loop import Loop
from servoscope.web import asked as asks
from servoscope.web import outcomes as answers
from servoscope.web import telling
from servoscope.web.context import Context, Engineer, In, Plain, Viewer
from servoscope.web.jobs import Job
from servoscope.web.parts import upload_of

__all__ = ["baseline_of", "id_of_asset", "loop_arguments", "router"]

router = APIRouter(tags=["baselines"])

OF_SERVICE = "service:"
EXAMPLES = ("reference-rig",)
JSON: dict[int | str, dict[str, Any]] = {
    200: {"content": {"application/json": {"schema": {"type": "object"}}}, "description": "The file"}
}


@dataclass(frozen=True)
class Kept:
    """A baseline's file, and what is told of it in a line."""

    path: Path
    row: Plain


def id_of_asset(context: Context, asset: str) -> str | None:
    """Return the id of the baseline that an asset is compared with, where the service file tells."""
    config = context.config
    if config is None or asset not in config.assets:
        return None
    file = config.assets[asset].baseline
    return OF_SERVICE + next(name for name, one in config.assets.items() if one.baseline == file)


def baseline_of(context: Context, id_: str) -> Kept:
    """Return a baseline.

    Raises
    ------
    HTTPException
        404: if there is none.
    BaselineError
        If its file cannot be used.
    """
    if not id_.startswith(OF_SERVICE):
        return _saved(context, context.folder.about("baselines", id_))
    config, asset = context.config, id_.removeprefix(OF_SERVICE)
    if config is None or id_of_asset(context, asset) != id_:
        raise HTTPException(404, f"there is no baseline {id_}")
    path = config.folder / config.assets[asset].baseline
    sharing = [name for name, one in config.assets.items() if one.baseline == config.assets[asset].baseline]
    row = {"id": id_, "name": path.name, "origin": "service", "assets": sharing, "at": None, "who": None}
    return Kept(path, {**row, **_facts(loaded(path))})


def _saved(context: Context, about: Plain) -> Kept:
    row = {"name": about["id"], "origin": "saved", "assets": [], "columns": None, "units": None, **about}
    return Kept(context.folder.path("baselines", about["id"]).absolute() / "baseline.json", row)


def _facts(baseline: Baseline) -> Plain:
    sources = [source for one in baseline.each for source in one.sources]
    return {
        "loop": baseline.loop.name,
        "hash": baseline.hash,
        "points": list(baseline.points),
        "columns": baseline.loop.columns.model_dump(mode="json"),
        "units": telling.units_of(baseline.loop.plant.units),
        "recordings": len(sources),
        "duration_s": sum(source.duration_s for source in sources),
    }


def loaded(path: Path) -> Baseline:
    """Return the baseline in a file, read once."""
    try:
        stamp = path.stat().st_mtime_ns
    except OSError:
        stamp = 0  # what is wrong with it, loading says best
    return _loaded(path, stamp)


@lru_cache(maxsize=64)
def _loaded(path: Path, _: int) -> Baseline:
    return Baseline.load(path)


def loop_arguments(context: Context, ref: asks.LoopRef) -> dict[str, str]:
    """Return a loop for a task, which reads it."""
    if ref.baseline is not None:
        return {"baseline": str(baseline_of(context, ref.baseline).path)}
    return {"example": ref.example} if ref.example is not None else {"toml": str(ref.toml)}


def _all(context: Context) -> list[Kept]:
    config = context.config
    ids = dict.fromkeys(id_of_asset(context, name) for name in config.assets) if config is not None else {}
    found = [baseline_of(context, id_) for id_ in ids if id_ is not None]
    return found + [_saved(context, about) for about in context.folder.all("baselines")]


@router.get("/baselines", response_model=answers.Baselines)
def baselines(context: In, _: Viewer) -> Plain:
    """List the baselines."""
    return {"baselines": [one.row for one in _all(context)]}


@router.get("/baselines/{id}", response_model=answers.Baseline)
def one(context: In, _: Viewer, id: str) -> Plain:
    """Tell a baseline: what was learned, and what it promises."""
    kept = baseline_of(context, id)
    return {**kept.row, "summary": summaries.finite(summaries.baseline(loaded(kept.path)))}


@router.get("/baselines/{id}/file", response_class=Response, responses=JSON)
def file(context: In, _: Viewer, id: str) -> Response:
    """Return its file, for `servoscope diagnose`."""
    kept = baseline_of(context, id)
    loaded(kept.path)
    name = f"{kept.row['name'].removesuffix('.json')}.json"
    return FileResponse(kept.path, media_type="application/json", filename=name)


@router.delete("/baselines/{id}", status_code=HTTP_204_NO_CONTENT)
def remove(context: In, who: Engineer, id: str) -> None:
    """Delete a baseline that was saved here."""
    if id.startswith(OF_SERVICE):
        raise HTTPException(409, f"{id} belongs to the service file")
    hash_ = context.folder.about("baselines", id)["hash"]
    context.store.note(who.user, "", "baseline deleted", {"baseline": id, "hash": hash_})
    context.folder.remove("baselines", id)


@router.get("/loops", response_model=answers.Loops)
def loops(context: In, _: Viewer) -> Plain:
    """List the loops that come with the program, and those of the baselines."""
    found = []
    for name in EXAMPLES:
        text = files("servoscope.examples").joinpath(f"{name}.toml").read_text(encoding="utf-8")
        found.append(_loop({"example": name}, Loop.from_dict(tomllib.loads(text)), text))
    found += [_loop({"baseline": kept.row["id"]}, loaded(kept.path).loop, None) for kept in _all(context)]
    return {"loops": found}


def _loop(ref: dict[str, str], loop: Loop, toml: str | None) -> Plain:
    facts = {"plant": loop.plant.kind, "sample_rate_hz": loop.sample_rate, "controller": loop.controller is not None}
    known = {"columns": loop.columns.model_dump(mode="json"), "units": telling.units_of(loop.plant.units)}
    return {"ref": ref, "name": loop.name, **facts, **known, "toml": toml}


@router.post("/learnings", response_model=answers.JobSaid, status_code=HTTP_202_ACCEPTED)
async def learn(context: In, who: Engineer, asked: asks.AskedLearning) -> Plain:
    """Learn from healthy uploads, and inspect each of them; a job. What it learned waits to be saved."""
    recordings = []
    for healthy in asked.recordings:
        folder, name = upload_of(context, healthy.upload)
        said = {"upload": healthy.upload, "name": name, "point": healthy.point}
        recordings.append({"file": str(folder / name), "point": healthy.point, "said": said})
    arguments: dict[str, Any] = {
        "recordings": recordings,
        "loop": await asyncio.to_thread(loop_arguments, context, asked.loop),
        "columns": asked.columns.given() if asked.columns is not None else None,
        "where": asked.where,
        "accept_change": asked.accept_change,
        "compare": None,
    }
    if asked.compare is not None:
        arguments["compare"] = str((await asyncio.to_thread(baseline_of, context, asked.compare)).path)
    id_, out = context.folder.new("learnings")

    def finish(said: Plain) -> Plain:
        context.folder.done("learnings", id_, {"who": who.user, "uploads": [one.upload for one in asked.recordings]})
        return {"learning": id_, **said}

    def abandon() -> None:
        context.folder.remove("learnings", id_)

    arguments["out"] = str(out.absolute())
    job = Job("learning", who.user, "learn", arguments, out.absolute(), finish, abandon)
    return context.jobs.submitted(job).plain()


@router.post("/baselines", response_model=answers.BaselineRow, status_code=HTTP_201_CREATED)
def save(context: In, who: Engineer, new: asks.NewBaseline) -> Plain:
    """Save what was learned under a name."""
    learned = context.folder.path("learnings", new.learning) / "baseline.json"
    facts = _facts(Baseline.load(learned))
    id_, folder = context.folder.new("baselines", new.name)
    try:
        shutil.copyfile(learned, folder / "baseline.json")
        context.store.note(who.user, "", "baseline saved", {"baseline": id_, "hash": facts["hash"]})
        about = context.folder.done("baselines", id_, {"who": who.user, **facts})
    except BaseException:
        context.folder.remove("baselines", id_)
        raise
    return _saved(context, about).row
