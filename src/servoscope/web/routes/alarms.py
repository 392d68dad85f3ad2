"""Alarms of all assets, the commands of operators, and the audit."""

from __future__ import annotations

import asyncio
import time
from typing import Annotated

from fastapi import APIRouter, HTTPException, Query, Response

from servoscope.service.alarms import FAULT_ALARM, alarm_kind
from servoscope.service.assets.status import AssetStatus, ServiceStatus
from servoscope.service.store.queries import query_history
from servoscope.web.checks import asset_checks, last_full_diagnosis
from servoscope.web.dependencies import VIEWER, Context, ContextDep, Operator
from servoscope.web.schemas import assets as schemas
from servoscope.web.schemas.requests import AssetQuery, AuditQuery, CommandName, CommandRequest, TransitionQuery
from servoscope.web.schemas.responses import AuditEntry, AuditList, DiagnosisRow, FaultCheck
from servoscope.web.statuses import read_statuses, service_statuses
from servoscope.web.stored_diagnosis import stored_headline

router = APIRouter(tags=["alarms"], dependencies=[VIEWER])

COMMAND_TIMEOUT_S = 5.0  # to wait for the service
COMMAND_POLL_S = 0.1


@router.get("/alarms")
def list_alarms(context: ContextDep, query: Annotated[AssetQuery, Query()]) -> schemas.AlarmList:
    """List the alarms that are not normal, the most urgent first."""
    mark = context.event_hub.mark
    statuses = read_statuses(context.store, query.assets or None)
    rows = [row for stored in statuses.values() for row in schemas.status_alarms(stored.name, stored.status)]
    rows.sort(key=lambda row: (not row.unacknowledged, -row.rank, -row.since, row.asset, row.alarm))
    floods = (status.flood for _, status in service_statuses(statuses.values()))
    return schemas.AlarmList(
        now=time.time(),
        mark=mark,
        alarms=[_with_advice(context, row, statuses[row.asset].status) for row in rows],
        flood=next((flood for flood in floods if flood.since is not None), None),
    )


def _with_advice(context: Context, row: schemas.AlarmRow, status: AssetStatus | ServiceStatus) -> schemas.AlarmDetail:
    """Return an alarm with what the service file says of it; of a fault with what to check."""
    definition = context.config.alarms.definitions.get(alarm_kind(row.alarm)) if context.config is not None else None
    known, checks = dict(row), list[FaultCheck]()
    full = last_full_diagnosis(context, row.asset) if row.alarm == FAULT_ALARM else None
    if row.alarm == FAULT_ALARM and isinstance(status, AssetStatus):
        checks = asset_checks(context, row.asset, status, full)
        if full is not None and status.verdict != "fault":
            known["cause"] = stored_headline(full)
    return schemas.AlarmDetail(
        **known,
        consequence=definition.consequence if definition is not None else None,
        operator_action=definition.operator_action if definition is not None else None,
        response_time_s=definition.response_time_s if definition is not None else None,
        checks=checks,
        diagnosis=DiagnosisRow.from_stored(full) if full is not None else None,
    )


@router.get("/alarms/history")
def list_transitions(context: ContextDep, query: Annotated[TransitionQuery, Query()]) -> schemas.TransitionList:
    """List transitions of alarms, the newest last."""
    # the store has no index of alarms: one of them is looked for among all rows
    last = query.last if query.alarm is None else None
    rows = query_history(context.store, "alarms", assets=query.assets, span=query.span, last=last)
    rows = [row for row in rows if query.alarm in (None, row["alarm"])][-query.last :]
    return schemas.TransitionList(transitions=[schemas.TransitionRow.from_stored(row) for row in rows])


@router.post(
    "/assets/{asset}/alarms/{alarm}/{command}",
    responses={202: {"model": schemas.CommandResult, "description": "Asked for; the service does not run now"}},
)
async def command_alarm(
    context: ContextDep,
    who: Operator,
    response: Response,
    asset: str,
    alarm: str,
    command: CommandName,
    request: CommandRequest,
) -> schemas.CommandResult:
    """Ask the service to carry out a command on an alarm, and wait a little for its outcome."""
    if (request.for_s is None) == (command == "shelve"):
        raise HTTPException(422, "for_s: give it with shelve, and with nothing else")
    if asset not in await asyncio.to_thread(context.store.statuses, [asset]):
        raise HTTPException(404, f"there is no asset {asset}")
    what = who.user, asset, alarm, command
    id_ = await asyncio.to_thread(context.store.add_command, *what, reason=request.why, for_s=request.for_s)
    deadline, outcome = time.monotonic() + COMMAND_TIMEOUT_S, None
    while outcome is None and time.monotonic() < deadline:
        await asyncio.sleep(COMMAND_POLL_S)
        outcome = await asyncio.to_thread(context.store.command_outcome, id_)
    if outcome is not None and not outcome.accepted:
        raise HTTPException(409, outcome.refusal)
    response.status_code = 200 if outcome is not None else 202
    text = outcome.text if outcome is not None else None
    return schemas.CommandResult(asset=asset, alarm=alarm, command=command, who=who.user, outcome=text)


@router.get("/audit")
def list_audit_entries(context: ContextDep, _: Operator, query: Annotated[AuditQuery, Query()]) -> AuditList:
    """List who did what, the newest last."""
    rows = query_history(context.store, "audit", assets=query.assets, span=query.span, last=query.last)
    return AuditList(entries=[AuditEntry.model_validate(row) for row in rows])
