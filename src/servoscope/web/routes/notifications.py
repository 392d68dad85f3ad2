"""Where notifications go, and a test of each."""

from __future__ import annotations

from fastapi import APIRouter, HTTPException

from servoscope.core.addresses import show_address
from servoscope.service.actions.settings import (
    SINKS,
    CommandSettings,
    EmailSettings,
    MqttMessageSettings,
    Sink,
    WebhookSettings,
)
from servoscope.service.store.queries import query_history
from servoscope.service.store.rows import TEST
from servoscope.web.dependencies import VIEWER, Context, ContextDep, Engineer
from servoscope.web.schemas.responses import NotificationOutlet, NotificationOutlets

router = APIRouter(tags=["alarms"], dependencies=[VIEWER])

DELIVERIES = 500  # newest ones of all outlets, among which the last one of each is looked for


def _target(sink: Sink) -> str:
    match sink:
        case WebhookSettings():
            return show_address(sink.url)
        case CommandSettings():
            return sink.argv[0]
        case MqttMessageSettings():
            return sink.topic
        case EmailSettings():
            return ", ".join(sink.to)


def _outlets(context: Context) -> dict[str, NotificationOutlet]:
    if context.config is None:
        return {}
    settings = context.config.actions
    newest = {
        row["sink"]: {
            "t": row["created"],
            "event": row["event"]["event"],
            "attempts": row["attempts"],
            "outcome": row["outcome"],
        }
        for row in query_history(context.store, "deliveries", last=DELIVERIES)
    }
    return {
        name: NotificationOutlet(
            name=name, kind=kind, target=_target(sink), may_test=name not in settings.executing, last=newest.get(name)
        )
        for kind in SINKS
        for name, sink in getattr(settings, kind).items()
    }


@router.get("/notifications")
def list_outlets(context: ContextDep) -> NotificationOutlets:
    """List where notifications go."""
    return NotificationOutlets(outlets=list(_outlets(context).values()))


@router.post("/notifications/{name}/test", status_code=202)
def test_outlet(context: ContextDep, who: Engineer, name: str) -> NotificationOutlet:
    """Ask the service to send a test; `last` is its delivery once there is one."""
    outlet, config = _outlets(context).get(name), context.config
    if outlet is None or config is None:
        raise HTTPException(404, f"there is no {name} in [actions]")
    if not outlet.may_test:
        raise HTTPException(409, f"{name} changes a machine and is not tested")
    service = config.name if config.service.workers == 1 else config.shard_name(min(config.shard_numbers()))
    context.store.add_command(who.user, service, name, TEST)
    return outlet
