"""Uploads: taken as they are, looked at in a process of their own; and the jobs that work on them."""

from __future__ import annotations

import asyncio
import errno
import re
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from starlette.exceptions import HTTPException
from starlette.status import HTTP_201_CREATED, HTTP_202_ACCEPTED, HTTP_204_NO_CONTENT

from servoscope.readers import SUFFIXES
from servoscope.web.asked import AskedInspection, OfJob, OfUpload
from servoscope.web.baselines import loop_arguments
from servoscope.web.context import In, Operator, Plain, Viewer
from servoscope.web.jobs import Job
from servoscope.web.outcomes import JobSaid, Upload, Uploads
from servoscope.web.parts import part_of, upload_of

router = APIRouter(tags=["uploads"])

KIND = "application/octet-stream"
SHARE = 10.0  # largest uploads that all of them together may be as large as
BODY = {"required": True, "content": {KIND: {"schema": {"type": "string", "format": "binary"}}}}


@router.post("/uploads", response_model=Upload, status_code=HTTP_201_CREATED, openapi_extra={"requestBody": BODY})
async def upload(context: In, who: Operator, request: Request, query: Annotated[OfUpload, Query()]) -> Plain:
    """Take a file, say which columns it has, and show its first rows."""
    if request.headers.get("content-type", "").split(";")[0].strip() != KIND:
        raise HTTPException(415, f"send the file as it is, as {KIND}")
    name = _name(query.name)
    most = SHARE * context.settings.upload_mb * 1e6
    if sum(one["bytes"] for one in context.folder.all("uploads")) > most:
        raise HTTPException(507, f"uploads take more than {most / 1e6:g} MB already: delete some")
    id_, folder = context.folder.new("uploads")
    try:
        size = await _receive(request, folder / name)
        said = await context.jobs.glance("look", {"file": name}, folder)
        await asyncio.to_thread(context.store.note, who.user, "", "upload", {"upload": id_, "name": name})
    except BaseException:
        context.folder.remove("uploads", id_)
        raise
    return context.folder.done("uploads", id_, {"name": name, "bytes": size, "who": who.user, **said})


def _name(said: str) -> str:
    """Return a name that is safe on disk and in messages, with a suffix that says what the file is."""
    name = re.sub(r"[^\w .()+=-]", "_", Path(said.replace("\\", "/")).name).strip(". ")
    stem, suffix = Path(name).stem[:80], Path(name).suffix.lower()
    if suffix not in SUFFIXES:
        raise HTTPException(422, f"name: {name[-40:]!r}: unknown kind of file; readable are {', '.join(SUFFIXES)}")
    return f"{stem}{suffix}"


async def _receive(request: Request, path: Path) -> int:
    size = 0
    try:
        with path.open("xb") as file:
            async for chunk in request.stream():
                size += len(chunk)
                await asyncio.to_thread(file.write, chunk)
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise HTTPException(507, "the server's disk is full") from None
        raise
    return size


@router.get("/uploads", response_model=Uploads)
def uploads(context: In, _: Viewer) -> Plain:
    """List the uploads."""
    return {"uploads": context.folder.all("uploads")}


@router.get("/uploads/{id}", response_model=Upload)
def one(context: In, _: Viewer, id: str) -> Plain:
    """Tell an upload."""
    return context.folder.about("uploads", id)


@router.delete("/uploads/{id}", status_code=HTTP_204_NO_CONTENT)
def remove(context: In, who: Operator, id: str) -> None:
    """Delete an upload; diagnoses of it stay."""
    name = context.folder.about("uploads", id)["name"]
    context.store.note(who.user, "", "upload deleted", {"upload": id, "name": name})
    context.folder.remove("uploads", id)


@router.post("/inspections", response_model=JobSaid, status_code=HTTP_202_ACCEPTED)
async def inspection(context: In, who: Operator, asked: AskedInspection) -> Plain:
    """Say whether an upload is usable, and if not, why; a job."""
    folder, file = upload_of(context, asked.upload)
    loop = await asyncio.to_thread(loop_arguments, context, asked.loop) if asked.loop is not None else None
    arguments: dict[str, Any] = {"file": file, "loop": loop, **part_of(asked)}
    return context.jobs.submitted(Job("inspection", who.user, "inspect", arguments, folder, lambda said: said)).plain()


@router.get("/jobs/{id}", response_model=JobSaid)
async def job(context: In, _: Viewer, id: str, query: Annotated[OfJob, Query()]) -> Plain:
    """Tell how far a job is; with `wait`, as soon as it has ended."""
    found = context.jobs.find(id)
    if query.wait and found.finished is None:
        try:
            await asyncio.wait_for(found.ended.wait(), query.wait)
        except TimeoutError:
            return found.plain()
    return found.plain()


@router.delete("/jobs/{id}", status_code=HTTP_204_NO_CONTENT)
async def stop(context: In, who: Operator, id: str) -> None:
    """Stop a job of one's own, or any with the role engineer."""
    found = context.jobs.find(id)
    if found.who != who.user and who.role != "engineer":
        raise HTTPException(403, f"it is {found.who}'s")
    context.jobs.stop(found)
