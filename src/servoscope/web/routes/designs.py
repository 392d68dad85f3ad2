"""Studies before deployment: which faults can be detected and isolated."""

from __future__ import annotations

import asyncio
import json
from functools import partial

from fastapi import APIRouter, Response

from servoscope.web.dependencies import VIEWER, ContextDep, Engineer
from servoscope.web.jobs.queue import Job
from servoscope.web.routes.baselines import resolve_loop
from servoscope.web.routes.diagnoses import HTML_RESPONSES, report_response
from servoscope.web.schemas.requests import DesignRequest
from servoscope.web.schemas.responses import DesignDetail, DesignList, DesignRow, JobResponse, JsonObject

router = APIRouter(tags=["designs"], dependencies=[VIEWER])


@router.get("/designs")
def list_designs(context: ContextDep) -> DesignList:
    """List the studies."""
    return DesignList(designs=context.storage.list(DesignRow))


@router.get("/designs/{id}")
def get_design(context: ContextDep, id: str) -> DesignDetail:
    """Return a study."""
    record = context.storage.read(DesignRow, id)
    study = (context.storage.path(DesignRow, id) / "study.json").read_text(encoding="utf-8")
    return DesignDetail(**dict(record), study=json.loads(study))


@router.get("/designs/{id}/report", response_class=Response, responses=HTML_RESPONSES)
def get_design_report(context: ContextDep, id: str) -> Response:
    """Return a study as a page to keep and print."""
    return report_response(context, DesignRow, id)


@router.post("/designs", status_code=202)
async def start_design(context: ContextDep, who: Engineer, request: DesignRequest) -> JobResponse:
    """Study which faults can be detected and isolated; a job."""
    paths = await asyncio.to_thread(context.storage.upload_paths, request.recordings)
    loop = await asyncio.to_thread(resolve_loop, context, request.loop)
    id_, out = await asyncio.to_thread(context.storage.create, "designs")

    def finish(result: JsonObject) -> JsonObject:
        context.store.add_audit(who.user, "", "design", {"design": id_, **result})
        context.storage.publish(DesignRow(id=id_, who=who.user, **result))
        return {"design": id_}

    arguments = request, loop, paths, str(out)
    discard = partial(context.storage.remove, "designs", id_)
    return context.jobs.submit(
        Job("design", who.user, "study_design", arguments, out, (*loop.files, *paths), out, finish, discard)
    )
