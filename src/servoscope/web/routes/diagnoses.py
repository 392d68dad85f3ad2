"""Diagnoses, of monitored assets and of uploads; each has a permanent address."""

from __future__ import annotations

import asyncio
import json
from functools import partial
from typing import Annotated, Any

import sqlalchemy as sa
from fastapi import APIRouter, HTTPException, Query, Response
from fastapi.responses import FileResponse

from servoscope.diagnosis.checks import suspects
from servoscope.diagnosis.result import Diagnosis
from servoscope.report.diagnosis_document import DiagnosisContext, diagnosis_document
from servoscope.report.document import to_json
from servoscope.service.assets.status import AssetMetadata
from servoscope.service.store import tables
from servoscope.service.store.queries import query_history
from servoscope.service.store.rows import BASELINE_NOTE
from servoscope.service.store.series import read_checks, read_notes
from servoscope.web.checks import asset_machine, fault_checks
from servoscope.web.dependencies import VIEWER, Context, ContextDep, Operator
from servoscope.web.jobs.queue import Job
from servoscope.web.middleware import API
from servoscope.web.routes.baselines import asset_baseline_id, find_baseline
from servoscope.web.schemas import responses
from servoscope.web.schemas.assets import signal_units
from servoscope.web.schemas.requests import DiagnosisQuery, DiagnosisRequest
from servoscope.web.statuses import asset_statuses, read_statuses
from servoscope.web.stored_diagnosis import STORED_BESIDE, read_diagnosis

router = APIRouter(tags=["diagnoses"], dependencies=[VIEWER])

UPLOAD_PREFIX = "u-"
MAX_NUMBER = 2**63 - 1
HTML_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {"content": {"text/html": {"schema": {"type": "string"}}}, "description": "A page that needs no other"}
}
# the policy of the report itself, which the server repeats: no script, and a frame only on the server's own pages
REPORT_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; frame-ancestors 'self'; sandbox allow-popups"
)


@router.get("/diagnoses")
def list_diagnoses(context: ContextDep, query: Annotated[DiagnosisQuery, Query()]) -> responses.DiagnosisList:
    """List diagnoses, the newest last."""
    rows: list[responses.DiagnosisRow] = []
    if query.grounds != "upload":
        # those with the verdict and grounds may be older than the newest rows: then all rows are read
        last = query.last if query.verdict is None and query.grounds is None else None
        stored = query_history(context.store, "diagnoses", assets=query.assets, span=query.span, last=last)
        rows = [responses.DiagnosisRow.from_stored(row) for row in stored]
    if query.asset is None and query.grounds in (None, "upload"):
        since, until = query.span
        rows += [
            _upload_row(record)
            for record in context.storage.list(responses.UploadDiagnosis)
            if (since is None or since <= record.at) and (until is None or record.at < until)
        ]
    rows = [row for row in rows if query.verdict in (None, row.verdict) and query.grounds in (None, row.grounds)]
    return responses.DiagnosisList(diagnoses=sorted(rows, key=lambda row: (row.t, row.id))[-query.last :])


def _upload_row(record: responses.UploadDiagnosis) -> responses.DiagnosisRow:
    return responses.DiagnosisRow(
        id=f"{UPLOAD_PREFIX}{record.id}",
        t=record.at,
        grounds="upload",
        verdict=record.verdict,
        summary=record.summary,
        recording=record.recording,
    )


@router.get("/diagnoses/{id}")
def get_diagnosis(context: ContextDep, id: str) -> responses.DiagnosisDetail:
    """Return a diagnosis."""
    return _upload_diagnosis(context, id) if _is_upload(id) else _asset_diagnosis(context, id)


def _is_upload(id_: str) -> bool:
    return id_.startswith(UPLOAD_PREFIX) and "@" not in id_


def _asset_diagnosis(context: Context, id_: str) -> responses.DiagnosisDetail:
    asset, _, number = id_.rpartition("@")
    table = tables.diagnoses
    rows = []
    if number.isascii() and number.isdecimal() and int(number) <= MAX_NUMBER:
        query = sa.select(table).where((table.c.asset == asset) & (table.c.number == int(number)))
        rows = context.store.fetch(query)
    if not rows:
        raise HTTPException(404, f"there is no diagnosis {id_}")
    document = dict(rows[0]["document"])
    diagnosis = read_diagnosis(document)
    beside = {key: document.pop(key, None) for key in STORED_BESIDE}
    began = beside["began"]
    facts = next(
        (status.metadata for _, status in asset_statuses(read_statuses(context.store, [asset]).values())), None
    )
    baseline = None
    if facts is not None and facts.model_fields_set:
        # of the diagnosis, which an asset that has learned again since no longer has
        used = diagnosis.provenance if diagnosis is not None else None
        known_hash = used.baseline if used is not None else beside["baseline"]
        if known_hash is None:  # of earlier versions
            known_hash = "" if _has_learned_again(context, asset, rows[0]["t"]) else facts.baseline or ""
        baseline = responses.BaselineRef(id=asset_baseline_id(context, asset), name=asset, hash=known_hash)
    known = _asset_context(context, asset, diagnosis, facts)._replace(began=began, onset=rows[0]["onset"])
    return responses.DiagnosisDetail(
        **dict(responses.DiagnosisRow.from_stored(rows[0])),
        began=began,
        signature=beside["signature"] or [],
        arm=beside["arm"],
        document=document,
        sections=to_json(diagnosis_document(diagnosis, known)) if diagnosis is not None else [],
        baseline=baseline,
        units=signal_units(facts.units) if facts is not None else None,
    )


def _has_learned_again(context: Context, asset: str, t: float) -> bool:
    notes = read_notes(context.store, asset)
    return any(note["kind"] == BASELINE_NOTE and note["t"] > t for note in notes)


def _asset_context(
    context: Context, asset: str, diagnosis: Diagnosis | None, facts: AssetMetadata | None
) -> DiagnosisContext:
    """Return what the diagnosis of an asset does not know itself."""
    machine, own = asset_machine(context, asset), read_checks(context.store, asset)
    names = suspects(diagnosis.current) if diagnosis is not None else ()
    checks = None
    if machine is not None or any(name in own for name in names):
        checks = [text for check in fault_checks(context, asset, machine, names) for text in check.texts]
    if facts is None:
        return DiagnosisContext(checks=checks)
    coefficients = dict(
        zip(diagnosis.parameters if diagnosis is not None else (), facts.coefficient_units, strict=False)
    )
    y, u = facts.units or ("", "")
    return DiagnosisContext(words=facts.faults, units=(y, u), coefficient_units=coefficients, checks=checks)


def _upload_diagnosis(context: Context, id_: str) -> responses.DiagnosisDetail:
    record = context.storage.read(responses.UploadDiagnosis, id_.removeprefix(UPLOAD_PREFIX))
    path = context.storage.path(responses.UploadDiagnosis, record.id) / "data.json"
    data = json.loads(path.read_bytes())
    trace = data["trace"]
    coefficients = {item["name"]: item["unit"] for item in trace["parameters"]} if trace is not None else {}
    y, u = data["units"]
    known = DiagnosisContext(words=data["words"], units=(y, u), coefficient_units=coefficients)
    return responses.DiagnosisDetail(
        **dict(_upload_row(record)),
        document=data["document"],
        sections=to_json(diagnosis_document(Diagnosis.model_validate(data["document"]), known)),
        who=record.who,
        baseline=record.baseline,
        units=signal_units(data["units"]),
        signals=data["signals"],
        trace=trace,
        arm=data.get("arm"),
        signature=data.get("signature", []),  # of earlier versions
        report=f"{API}/diagnoses/{id_}/report",
        upload=record.upload,
    )


@router.get("/diagnoses/{id}/report", response_class=Response, responses=HTML_RESPONSES)
def get_diagnosis_report(context: ContextDep, id: str) -> Response:
    """Return the report on an upload, a page to keep and print."""
    if not _is_upload(id):
        raise HTTPException(404, f"{id}: reports are made of uploads; the page of a diagnosis can be printed too")
    return report_response(context, responses.UploadDiagnosis, id.removeprefix(UPLOAD_PREFIX))


def report_response(context: Context, model: type[responses.StorageRecord], id_: str) -> Response:
    """Return the page that a job wrote."""
    path = context.storage.path(model, id_) / "report.html"
    return FileResponse(path, media_type="text/html", headers={"Content-Security-Policy": REPORT_POLICY})


@router.post("/diagnoses", status_code=202)
async def start_diagnosis(context: ContextDep, who: Operator, request: DiagnosisRequest) -> responses.JobResponse:
    """Diagnose an upload with a baseline; a job."""
    file = await asyncio.to_thread(context.storage.upload, request.upload)
    baseline = await asyncio.to_thread(find_baseline, context, request.baseline)
    id_, out = await asyncio.to_thread(context.storage.create, "diagnoses")

    def finish(result: responses.JsonObject) -> responses.JsonObject:
        used = responses.BaselineRef(id=request.baseline, name=baseline.row.name, hash=result["hash"])
        note = {"diagnosis": id_, "recording": result["recording"], **used.model_dump()}
        context.store.add_audit(who.user, "", "diagnosis", note)
        record = {**result, "id": id_, "who": who.user, "baseline": used, "upload": request.upload}
        context.storage.publish(responses.UploadDiagnosis.model_validate(record))
        return {"diagnosis": f"{UPLOAD_PREFIX}{id_}"}

    path = str(baseline.path)
    arguments = file.name, request, path, baseline.row.name, str(out)
    discard = partial(context.storage.remove, "diagnoses", id_)
    return context.jobs.submit(
        Job("diagnosis", who.user, "diagnose_file", arguments, file.parent, (path,), out, finish, discard)
    )
