"""Diagnoses, of followed assets and of uploads; each has an address for good."""

from __future__ import annotations

import asyncio
import json
from typing import Annotated, Any

import sqlalchemy as sa
from fastapi import APIRouter, Query
from fastapi.responses import FileResponse
from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.status import HTTP_202_ACCEPTED

from servoscope.store import tables
from servoscope.store.history import history
from servoscope.web import telling
from servoscope.web.asked import AskedDiagnosis, OfDiagnoses
from servoscope.web.baselines import baseline_of, id_of_asset
from servoscope.web.context import Context, In, Operator, Plain, Viewer
from servoscope.web.guard import API
from servoscope.web.jobs import Job
from servoscope.web.outcomes import Diagnoses, Diagnosis, JobSaid
from servoscope.web.parts import part_of, upload_of

__all__ = ["HTML", "router", "shown_page"]

router = APIRouter(tags=["diagnoses"])

OF_UPLOAD = "u-"
MOST_NUMBER = 2**63 - 1
HTML: dict[int | str, dict[str, Any]] = {
    200: {"content": {"text/html": {"schema": {"type": "string"}}}, "description": "A page that needs no other"}
}
# the report's own policy, and the server's word for it: no script, and a frame only on the server's own pages
REPORT_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; frame-ancestors 'self'; sandbox allow-popups"
)


@router.get("/diagnoses", response_model=Diagnoses)
def diagnoses(context: In, _: Viewer, query: Annotated[OfDiagnoses, Query()]) -> Plain:
    """List diagnoses, the newest last."""
    rows: list[Plain] = []
    if query.grounds != "upload":
        assets, span = [query.asset] if query.asset is not None else [], (query.since, query.until)
        # what verdict and grounds leave over may be older than the newest rows: then all are looked at
        last = query.last if query.verdict is None and query.grounds is None else None
        rows = [
            telling.diagnosis_row(row)
            for row in history(context.store, "diagnoses", assets=assets, span=span, last=last)
        ]
    if query.asset is None and query.grounds in (None, "upload"):
        low, high = (-1e300 if query.since is None else query.since), (1e300 if query.until is None else query.until)
        rows += [row for row in map(_row, context.folder.all("diagnoses")) if low <= row["t"] < high]
    rows = [row for row in rows if query.verdict in (None, row["verdict"]) and query.grounds in (None, row["grounds"])]
    return {"diagnoses": sorted(rows, key=lambda row: (row["t"], row["id"]))[-query.last :]}


def _row(about: Plain) -> Plain:
    kept = {"verdict": about["verdict"], "summary": about["summary"], "recording": about["recording"]}
    nothing = {"asset": None, "number": None, "onset": None}
    return {"id": f"{OF_UPLOAD}{about['id']}", "t": about["at"], "grounds": "upload", **nothing, **kept}


@router.get("/diagnoses/{id}", response_model=Diagnosis)
def diagnosis(context: In, _: Viewer, id: str) -> Plain:
    """Tell a diagnosis."""
    return _of_upload(context, id) if _is_upload(id) else _of_asset(context, id)


def _is_upload(id_: str) -> bool:
    return id_.startswith(OF_UPLOAD) and "@" not in id_


def _of_asset(context: Context, id_: str) -> Plain:
    asset, _, number = id_.rpartition("@")
    table = tables.diagnoses
    found = []
    if number.isascii() and number.isdecimal() and int(number) <= MOST_NUMBER:
        query = sa.select(table).where((table.c.asset == asset) & (table.c.number == int(number)))
        found = context.store.rows(query)
    if not found:
        raise HTTPException(404, f"there is no diagnosis {id_}")
    row, document = found[0], dict(found[0]["document"])
    status = context.store.statuses([asset]).get(asset)
    about = status["status"].get("about", {}) if status is not None else {}
    baseline = id_of_asset(context, asset)
    return {
        **telling.diagnosis_row(row),
        "began": document.pop("began", None),
        "document": document,
        "words": about.get("faults", {}),
        "who": None,
        # of the baseline that the asset has now: which one it had then, the store does not know
        "baseline": {"id": baseline, "name": asset, "hash": about.get("baseline") or ""} if about else None,
        "units": telling.units_of(about.get("units")),
        "coefficient_units": list(about.get("coefficient_units", ())),
        "signals": None,
        "trace": None,
        "report": None,
        "upload": None,
    }


def _of_upload(context: Context, id_: str) -> Plain:
    about = context.folder.about("diagnoses", id_.removeprefix(OF_UPLOAD))
    data = json.loads((context.folder.path("diagnoses", about["id"]) / "data.json").read_text(encoding="utf-8"))
    return {
        **_row(about),
        **data,
        "units": telling.units_of(data["units"]),
        "coefficient_units": [one["unit"] for one in data["trace"]["parameters"]],
        "began": None,
        "who": about["who"],
        "baseline": about["baseline"],
        "report": f"{API}/diagnoses/{id_}/report",
        "upload": about.get("upload"),
    }


@router.get("/diagnoses/{id}/report", response_class=Response, responses=HTML)
def report(context: In, _: Viewer, id: str) -> Response:
    """Return the report on an upload, a page that can be kept and printed."""
    if not _is_upload(id):
        raise HTTPException(404, f"{id}: reports are made of uploads; the page of a diagnosis can be printed too")
    return shown_page(context, "diagnoses", id.removeprefix(OF_UPLOAD))


def shown_page(context: Context, kind: str, id_: str) -> Response:
    """Return the page that a job wrote."""
    path = context.folder.path("designs" if kind == "designs" else "diagnoses", id_) / "report.html"
    return FileResponse(path, media_type="text/html", headers={"Content-Security-Policy": REPORT_POLICY})


@router.post("/diagnoses", response_model=JobSaid, status_code=HTTP_202_ACCEPTED)
async def diagnose(context: In, who: Operator, asked: AskedDiagnosis) -> Plain:
    """Diagnose an upload with a baseline; a job."""
    folder, file = upload_of(context, asked.upload)
    baseline = await asyncio.to_thread(baseline_of, context, asked.baseline)
    id_, out = context.folder.new("diagnoses")
    arguments = {
        "file": file,
        "baseline": str(baseline.path),
        "name": baseline.row["name"],
        "point": asked.point,
        "out": str(out.absolute()),
        **part_of(asked),
    }

    def finish(said: Plain) -> Plain:
        hash_ = said.pop("hash")
        origin = {"id": asked.baseline, "name": baseline.row["name"], "hash": hash_}
        context.store.note(who.user, "", "diagnosis", {"diagnosis": id_, "recording": said["recording"], **origin})
        context.folder.done("diagnoses", id_, {"who": who.user, "baseline": origin, "upload": asked.upload, **said})
        return {"diagnosis": f"{OF_UPLOAD}{id_}"}

    def abandon() -> None:
        context.folder.remove("diagnoses", id_)

    job = Job("diagnosis", who.user, "diagnose", arguments, folder, finish, abandon)
    return context.jobs.submitted(job).plain()
