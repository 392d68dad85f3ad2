"""Alarms of all assets, what operators may do with them, and the audit."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Mapping
from typing import Annotated, Any

from fastapi import APIRouter, Query, Response
from starlette.exceptions import HTTPException

from servoscope.alarms import PRIORITIES
from servoscope.store.history import history
from servoscope.web import telling
from servoscope.web.asked import CommandName, OfAlarmRows, OfAlarms, OfAudit, Reasons
from servoscope.web.context import Context, In, Operator, Plain, Viewer
from servoscope.web.hub import of_services
from servoscope.web.said import Alarms, Audit, Commanded, Transitions

router = APIRouter(tags=["alarms"])

PATIENCE_S = 5.0  # that the service is waited for
ADVICE = ("consequence", "operator_action", "response_time_s")
SHELVES_S = 366.0 * 86400.0


@router.get("/alarms", response_model=Alarms)
def alarms(context: In, _: Viewer, query: Annotated[OfAlarms, Query()]) -> Plain:
    """List the alarms that are not normal, the most urgent first."""
    statuses = context.store.statuses([query.asset] if query.asset is not None else None)
    found = [one for name, row in statuses.items() for one in telling.alarms(name, row["status"])]
    found.sort(key=lambda one: (_answered(one), -_rank(one), -one["since"], one["asset"], one["alarm"]))
    floods = [row["status"]["flood"] for row in of_services(statuses).values()]
    flood = next((one for one in floods if one["since"] is not None), None)
    return {"now": time.time(), "alarms": [{**one, **_advice(context, one)} for one in found], "flood": flood}


def _answered(one: Mapping[str, Any]) -> bool:
    return one["state"] not in telling.WAITING


def _rank(one: Mapping[str, Any]) -> int:
    return PRIORITIES.index(one["priority"]) if one["priority"] in PRIORITIES else -1


def _advice(context: Context, one: Mapping[str, Any]) -> Plain:
    """Return what the service file says of an alarm; nothing where the server has no such file."""
    config = context.config
    definition = config.alarms.definitions.get(one["alarm"]) if config is not None else None
    return {key: getattr(definition, key, None) for key in ADVICE}


@router.get("/alarms/history", response_model=Transitions)
def transitions(context: In, _: Viewer, query: Annotated[OfAlarmRows, Query()]) -> Plain:
    """Tell what became of alarms, the newest last."""
    assets = [query.asset] if query.asset is not None else []
    # one alarm is looked for among all: the store knows no index of names
    last = query.last if query.alarm is None else None
    rows = history(context.store, "alarms", assets=assets, span=(query.since, query.until), last=last)
    rows = [row for row in rows if query.alarm in (None, row["alarm"])][-query.last :]
    return {"transitions": [telling.transition(row) for row in rows]}


@router.post(
    "/assets/{asset}/alarms/{alarm}/{command}",
    response_model=Commanded,
    responses={202: {"model": Commanded, "description": "Asked for; the service does not run now"}},
)
async def command(
    context: In, who: Operator, response: Response, asset: str, alarm: str, command: CommandName, reasons: Reasons
) -> Plain:
    """Ask the service to carry out a command on an alarm, and wait a little for what becomes of it."""
    if (reasons.for_s is None) == (command == "shelve"):
        raise HTTPException(422, "for_s: give it with shelve, and with nothing else")
    said = await asyncio.to_thread(context.store.statuses, [asset])
    if asset not in said:
        raise HTTPException(404, f"there is no asset {asset}")
    document = {"why": reasons.why, **({"for_s": reasons.for_s} if reasons.for_s is not None else {})}
    row = {"who": who.user, "asset": asset, "alarm": alarm, "command": command, "document": document}
    asked = await asyncio.to_thread(context.store.ask, row)
    deadline = time.monotonic() + PATIENCE_S
    while (outcome := await asyncio.to_thread(context.store.outcome, asked)) is None and time.monotonic() < deadline:
        await asyncio.sleep(0.1)
    if outcome is not None and outcome.startswith("refused: "):
        raise HTTPException(409, outcome.removeprefix("refused: "))
    response.status_code = 200 if outcome is not None else 202
    return {"asset": asset, "alarm": alarm, "command": command, "who": who.user, "outcome": outcome}


@router.get("/audit", response_model=Audit)
def audit(context: In, _: Operator, query: Annotated[OfAudit, Query()]) -> Plain:
    """Tell who did what, the newest last."""
    assets = [query.asset] if query.asset is not None else []
    rows = history(context.store, "audit", assets=assets, span=(query.since, query.until), last=query.last)
    return {"entries": rows}
