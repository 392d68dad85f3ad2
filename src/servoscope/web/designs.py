"""Studies before deployment: what can be detected and told apart."""

from __future__ import annotations

import asyncio
import json
from typing import Any

from fastapi import APIRouter
from starlette.responses import Response
from starlette.status import HTTP_202_ACCEPTED

from servoscope.simulation.closed_loop import NOISE_U_STD, NOISE_Y_STD
from servoscope.web.asked import AskedDesign
from servoscope.web.baselines import loop_arguments
from servoscope.web.context import Engineer, In, Plain, Viewer
from servoscope.web.diagnoses import HTML, shown_page
from servoscope.web.jobs import Job
from servoscope.web.outcomes import Design, Designs, JobSaid
from servoscope.web.parts import upload_of

router = APIRouter(tags=["designs"])


@router.get("/designs", response_model=Designs)
def designs(context: In, _: Viewer) -> Plain:
    """List the studies."""
    return {"designs": context.folder.all("designs")}


@router.get("/designs/{id}", response_model=Design)
def one(context: In, _: Viewer, id: str) -> Plain:
    """Tell a study."""
    about = context.folder.about("designs", id)
    path = context.folder.path("designs", id) / "study.json"
    return {**about, "study": json.loads(path.read_text(encoding="utf-8"))}


@router.get("/designs/{id}/report", response_class=Response, responses=HTML)
def report(context: In, _: Viewer, id: str) -> Response:
    """Return a study as a page that can be kept and printed."""
    return shown_page(context, "designs", id)


@router.post("/designs", response_model=JobSaid, status_code=HTTP_202_ACCEPTED)
async def design(context: In, who: Engineer, asked: AskedDesign) -> Plain:
    """Study which faults can be detected and told apart; a job."""
    places = [upload_of(context, upload) for upload in asked.recordings]
    arguments: dict[str, Any] = {
        "loop": await asyncio.to_thread(loop_arguments, context, asked.loop),
        "files": [str(folder / name) for folder, name in places],
        "columns": asked.columns.given() if asked.columns is not None else None,
        "reference": asked.reference,
        "after_s": asked.after_s,
        "noise_u_std": asked.noise_u_std if asked.noise_u_std is not None else NOISE_U_STD,
        "noise_y_std": asked.noise_y_std if asked.noise_y_std is not None else NOISE_Y_STD,
    }
    id_, out = context.folder.new("designs")

    def finish(said: Plain) -> Plain:
        context.store.note(who.user, "", "design", {"design": id_, **said})
        context.folder.done("designs", id_, {"who": who.user, **said})
        return {"design": id_}

    def abandon() -> None:
        context.folder.remove("designs", id_)

    arguments["out"] = str(out.absolute())
    job = Job("design", who.user, "design", arguments, out.absolute(), finish, abandon)
    return context.jobs.submitted(job).plain()
