"""Uploads: stored as they are, inspected in a process with limits; and the jobs that read them."""

from __future__ import annotations

import asyncio
import errno
import re
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, HTTPException, Query, Request

from servoscope.signals.readers import readable_suffixes
from servoscope.web.dependencies import VIEWER, ContextDep, Operator
from servoscope.web.jobs.queue import Job
from servoscope.web.routes.baselines import resolve_loop
from servoscope.web.schemas.requests import InspectionRequest, JobQuery, ProposalRequest, UploadQuery
from servoscope.web.schemas.responses import FilePreview, JobResponse, UploadDetail, UploadList, UploadRow

router = APIRouter(tags=["uploads"], dependencies=[VIEWER])

UPLOAD_TYPE = "application/octet-stream"
STORAGE_FACTOR = 10.0  # times the largest upload that all uploads together may take
REQUEST_BODY = {"required": True, "content": {UPLOAD_TYPE: {"schema": {"type": "string", "format": "binary"}}}}


@router.post("/uploads", status_code=201, openapi_extra={"requestBody": REQUEST_BODY})
async def create_upload(
    context: ContextDep, who: Operator, request: Request, query: Annotated[UploadQuery, Query()]
) -> UploadDetail:
    """Store a file, and return its columns and first rows."""
    if request.headers.get("content-type", "").split(";")[0].strip() != UPLOAD_TYPE:
        raise HTTPException(415, f"send the file as it is, as {UPLOAD_TYPE}")
    name = _safe_name(query.name)
    largest = context.settings.upload_mb * 1e6
    # a body whose length is not told may have any
    expected = float(request.headers.get("content-length", largest))
    id_, folder = await asyncio.to_thread(context.uploads.create, expected, STORAGE_FACTOR * largest)
    try:
        size = await _save_body(request, folder / name)
        preview = FilePreview.model_validate(await context.jobs.run_now("preview_file", folder, name))
        await asyncio.to_thread(context.store.add_audit, who.user, "", "upload", {"upload": id_, "name": name})
        row = UploadRow(id=id_, name=name, bytes=size, who=who.user)
        return await asyncio.to_thread(context.uploads.publish, row, preview)
    except BaseException:
        # in a thread that a client who has gone does not stop
        asyncio.get_running_loop().run_in_executor(None, context.uploads.discard, id_)
        raise


def _safe_name(name: str) -> str:
    """Return a name that is safe on disk and in messages, with a suffix that tells the kind of file."""
    name = re.sub(r"[^\w .()+=-]", "_", Path(name.replace("\\", "/")).name).strip(". ")
    stem, suffix = Path(name).stem[:80], Path(name).suffix.lower()
    if suffix not in readable_suffixes():
        known = ", ".join(readable_suffixes())
        raise HTTPException(422, f"name: {name[-40:]!r}: unknown kind of file; readable are {known}")
    return f"{stem}{suffix}"


async def _save_body(request: Request, path: Path) -> int:
    size = 0
    try:
        with await asyncio.to_thread(path.open, "xb") as file:
            async for chunk in request.stream():
                size += len(chunk)
                await asyncio.to_thread(file.write, chunk)
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise HTTPException(507, "the server's disk is full") from None
        raise
    return size


@router.get("/uploads")
def list_uploads(context: ContextDep) -> UploadList:
    """List the uploads."""
    return UploadList(uploads=context.storage.list(UploadRow), suffixes=readable_suffixes())


@router.get("/uploads/{id}")
def get_upload(context: ContextDep, id: str) -> UploadDetail:
    """Return an upload."""
    return context.uploads.read(id)


@router.delete("/uploads/{id}", status_code=204)
def delete_upload(context: ContextDep, who: Operator, id: str) -> None:
    """Delete an upload; diagnoses of it stay."""
    record = context.storage.read(UploadRow, id)
    context.store.add_audit(who.user, "", "upload deleted", {"upload": id, "name": record.name})
    context.storage.remove("uploads", id)


@router.post("/inspections", status_code=202)
async def start_inspection(context: ContextDep, who: Operator, request: InspectionRequest) -> JobResponse:
    """Find out whether an upload is usable, and if not, why; a job."""
    file = await asyncio.to_thread(context.storage.upload, request.upload)
    loop = await asyncio.to_thread(resolve_loop, context, request.loop) if request.loop is not None else None
    arguments, reads = (file.name, request, loop), loop.files if loop is not None else ()
    return context.jobs.submit(
        Job("inspection", who.user, "inspect_file", arguments, file.parent, reads, None, lambda result: result)
    )


@router.post("/assessments", status_code=202)
async def start_assessment(context: ContextDep, who: Operator, request: InspectionRequest) -> JobResponse:
    """Find out what is most likely wrong with a loop, from one log without a baseline; a job."""
    file = await asyncio.to_thread(context.storage.upload, request.upload)
    return context.jobs.submit(
        Job("assessment", who.user, "assess_file", (file.name, request), file.parent, (), None, lambda result: result)
    )


@router.post("/proposals", status_code=202)
async def start_proposal(context: ContextDep, who: Operator, request: ProposalRequest) -> JobResponse:
    """Propose a loop file for an upload, with the evidence for each line, and inspect the upload with it; a job."""
    file = await asyncio.to_thread(context.storage.upload, request.upload)
    return context.jobs.submit(
        Job("proposal", who.user, "propose_file", (file.name, request), file.parent, (), None, lambda result: result)
    )


@router.get("/jobs/{id}")
async def get_job(context: ContextDep, id: str, query: Annotated[JobQuery, Query()]) -> JobResponse:
    """Return how far a job is; with `wait`, as soon as it has ended."""
    job = context.jobs.find(id)
    if query.wait:
        await asyncio.wait([job.handle], timeout=query.wait)
    return job.response


@router.delete("/jobs/{id}", status_code=204)
async def cancel_job(context: ContextDep, who: Operator, id: str) -> None:
    """Stop one's own job, or any with the role engineer."""
    job = context.jobs.find(id)
    if job.user != who.user and who.role != "engineer":
        raise HTTPException(403, f"it is {job.user}'s")
    job.handle.cancel()
