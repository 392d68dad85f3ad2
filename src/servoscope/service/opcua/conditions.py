"""Alarms as conditions of OPC UA Part 9: an event for each change, ConditionRefresh, and what operators do to them."""

from __future__ import annotations

import asyncio
import hashlib
import math
import threading
import time
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from typing import Any, NamedTuple

from servoscope.service.alarms import LifecycleEvent, LifecycleState, Priority
from servoscope.service.alarms.records import LATCHED_STATES, TRANSITION_TABLE, UNACKNOWLEDGED_STATES
from servoscope.service.opcua.settings import import_ua
from servoscope.service.publishers.base import AlarmCommand

ANSWER_WITHIN_S = 10.0  # a command is executed at the service's next housekeeping, and answered when that is stored
SEVERITIES: Mapping[Priority | None, int] = {None: 100, "low": 250, "medium": 500, "high": 750, "critical": 1000}
ACTIVE_STATES = (LifecycleState.UNACKNOWLEDGED, LifecycleState.ACKNOWLEDGED)
TWO_STATES = {  # of a condition, in words: where it holds, where not
    "EnabledState": ("Enabled", "Disabled"), "ActiveState": ("Active", "Inactive"),
    "AckedState": ("Acknowledged", "Unacknowledged"), "ConfirmedState": ("Confirmed", "Unconfirmed"),
    "LatchedState": ("Latched", "Unlatched"), "SuppressedState": ("Suppressed", "Unsuppressed"),
    "OutOfServiceState": ("Out of Service", "In Service"),
}  # fmt: skip
COMMENTED = {  # methods that name an event and a comment
    "AcknowledgeableConditionType_Acknowledge": LifecycleEvent.ACKNOWLEDGE,
    "AcknowledgeableConditionType_Confirm": LifecycleEvent.RESET,
}
PLAIN = {  # methods that name neither; of these a client may give the method of the type or of its component
    ("ShelvedStateMachineType_TimedShelve", "AlarmConditionType_ShelvingState_TimedShelve"): LifecycleEvent.SHELVE,
    ("ShelvedStateMachineType_Unshelve", "AlarmConditionType_ShelvingState_Unshelve"): LifecycleEvent.UNSHELVE,
    ("AlarmConditionType_Reset",): LifecycleEvent.RESET,
    ("AlarmConditionType_RemoveFromService",): LifecycleEvent.REMOVE,
    ("AlarmConditionType_PlaceInService",): LifecycleEvent.RESTORE,
}
REFUSALS = {  # what a command is answered that means nothing in the state of the alarm
    LifecycleEvent.ACKNOWLEDGE: "BadConditionBranchAlreadyAcked",
    LifecycleEvent.RESET: "BadConditionBranchAlreadyConfirmed",
    LifecycleEvent.UNSHELVE: "BadConditionNotShelved",
}


class Condition(NamedTuple):
    """An alarm as it was announced last."""

    asset: str
    alarm: str
    state: LifecycleState
    since: float  # [UTC s]
    cause: str
    priority: Priority | None
    active: bool
    until: float | None  # end of its shelving [UTC s]
    ne107: str | None

    @classmethod
    def from_status(cls, asset: str, alarm: str, status: Mapping[str, Any]) -> Condition:
        """Return the condition that the status of an alarm describes."""
        state = LifecycleState(status["state"])
        active = bool(status.get("active", state in ACTIVE_STATES))
        cause, priority, until = status.get("cause", ""), status.get("priority"), status.get("until")
        return cls(asset, alarm, state, status["since"], cause, priority, active, until, status.get("ne107"))

    def normal(self, since: float) -> Condition:
        """Return it as it is when nothing is wrong any more, since then [UTC s]."""
        return self._replace(state=LifecycleState.NORMAL, since=since, active=False, until=None)

    @property
    def event_id(self) -> bytes:
        """What names this event: the same after a restart; it begins with the alarm and its state."""
        state = repr((self.asset, self.alarm, str(self.state), self.since))
        return b"".join(hashlib.sha256(text.encode()).digest()[:8] for text in (state, repr(self)))

    @property
    def two_states(self) -> dict[str, bool]:
        """Return each of `TWO_STATES`, whether it holds."""
        return {
            "EnabledState": True,
            "ActiveState": self.active,
            "AckedState": self.state not in UNACKNOWLEDGED_STATES,
            "ConfirmedState": self.state not in LATCHED_STATES,
            "LatchedState": self.state in LATCHED_STATES,
            "SuppressedState": self.state is LifecycleState.SUPPRESSED,
            "OutOfServiceState": self.state is LifecycleState.OUT_OF_SERVICE,
        }


class _Shown(NamedTuple):
    """A condition that clients know: its event, and what waits for its next one."""

    condition: Condition
    event_ids: frozenset[bytes]  # beginnings of those that may be acknowledged: since it has been waiting for that
    comment: tuple[str, datetime] = "", datetime.fromtimestamp(0.0, UTC)
    user: str = ""


class AlarmConditions:
    """Raises events at the node Server of a server, and takes what clients command if `operate` says so.

    A condition is no full instance in the address space, which Part 9 allows: an object of its name has the methods.
    `who`: what the audit calls the clients, since the library does not say who calls a method.
    """

    def __init__(self, server: Any, index: int, types: Mapping[str, Any], who: str, *, operate: bool) -> None:
        self._server, self._index, self._types, self._who, self._operate = server, index, types, who, operate
        self._shown: dict[str, _Shown] = {}  # by identifier of its node
        self._names = set[str]()  # of all alarms that have been shown
        self._changed = asyncio.Condition()
        self._requests = list[AlarmCommand]()
        self._lock = threading.Lock()

    async def link(self) -> None:
        """Answer the methods of the standard's types, and filters as Part 4 says."""
        from asyncua.common.callback import CallbackType

        ua = import_ua()
        for name, event in COMMENTED.items():
            self._server.link_method(self._server.get_node(getattr(ua.ObjectIds, name)), self._commented(event))
        for names, event in PLAIN.items():
            for name in names:
                self._server.link_method(self._server.get_node(getattr(ua.ObjectIds, name)), self._plain(event))
        self._server.subscribe_server_callback(CallbackType.ItemSubscriptionCreated, self._complete_filters)

    async def _complete_filters(self, created: Any, _: Any) -> None:
        """Let a filter for a type take its subtypes, and any filter the events around a refresh.

        The library compares types for equality, and its list of elements is the one of the request.
        """
        from asyncua.common.ua_utils import get_node_subtypes

        ua = import_ua()
        around = [
            ua.LiteralOperand(Value=ua.Variant(ua.NodeId(getattr(ua.ObjectIds, f"Refresh{word}EventType"))))
            for word in ("Start", "End", "Required")
        ]
        for item in created.request_params.ItemsToCreate:
            where = getattr(item.RequestedParameters.Filter, "WhereClause", None)
            for element in where.Elements if where is not None else ():
                if element.FilterOperator == ua.FilterOperator.OfType:
                    path = [ua.QualifiedName("EventType", 0)]
                    field = ua.SimpleAttributeOperand(BrowsePath=path, AttributeId=ua.AttributeIds.Value)
                    of = self._server.get_node(element.FilterOperands[0].Value.Value)
                    subtypes = [node.nodeid for node in await get_node_subtypes(of)]
                    kinds = [ua.LiteralOperand(Value=ua.Variant(kind)) for kind in subtypes]
                    element.FilterOperator, element.FilterOperands = ua.FilterOperator.InList, [field, *kinds]
                if element.FilterOperator == ua.FilterOperator.InList:
                    element.FilterOperands.extend(around)

    async def update(self, source: Any, asset: str, status: Mapping[str, Any]) -> None:
        """Announce the alarms of an asset, whose object is `source`, that have changed."""
        ua = import_ua()
        alarms = {name: Condition.from_status(asset, name, alarm) for name, alarm in status.get("alarms", {}).items()}
        for name in self._names - alarms.keys():  # what a status does not name is normal
            shown = self._shown.get(f"{asset}.alarm.{name}")
            if shown is not None and shown.condition.state is not LifecycleState.NORMAL:
                alarms[name] = shown.condition.normal(_now(status))
        for name, condition in alarms.items():
            identifier = f"{asset}.alarm.{name}"
            before = self._shown.get(identifier)
            if condition.state is LifecycleState.NORMAL if before is None else before.condition == condition:
                continue
            if before is None:
                self._names.add(name)
                await self._add_object(source, identifier, name)
                before = _Shown(condition, frozenset())
            is_new = condition.state in (LifecycleState.NORMAL, LifecycleState.UNACKNOWLEDGED)
            known = frozenset() if is_new else before.event_ids
            shown = before._replace(condition=condition, event_ids=known | {condition.event_id[:8]})
            self._shown[identifier] = shown
            event = _event(shown, ua.NodeId(identifier, self._index), source.nodeid, self._types)
            await self._server.iserver.subscription_service.trigger_event(event)
        async with self._changed:
            self._changed.notify_all()

    async def _add_object(self, source: Any, identifier: str, name: str) -> None:
        """Add an object that has the methods of the types."""
        ua = import_ua()
        node = await source.add_object(f"ns={self._index};s={identifier}", f"{self._index}:{name}")
        for method in (*COMMENTED, *(names[0] for names in PLAIN)):
            await node.add_reference(ua.NodeId(getattr(ua.ObjectIds, method)), ua.ObjectIds.HasComponent)

    def _commented(self, event: LifecycleEvent) -> Callable[..., Any]:
        async def answer(parent: Any, event_id: Any = None, comment: Any = None, *_: Any) -> Any:
            words = getattr(getattr(comment, "Value", None), "Text", None) or ""
            return await self._command(parent, event, words, event_id=getattr(event_id, "Value", None) or b"")

        return answer

    def _plain(self, event: LifecycleEvent) -> Callable[..., Any]:
        async def answer(parent: Any, time_ms: Any = None, *_: Any) -> Any:
            for_s = None if event is not LifecycleEvent.SHELVE else float(getattr(time_ms, "Value", None) or 0.0) / 1e3
            return await self._command(parent, event, "", for_s=for_s)

        return answer

    async def _command(
        self, node: Any, event: LifecycleEvent, words: str, *, event_id: bytes | None = None, for_s: float | None = None
    ) -> Any:
        """Hand a command to the service, and return as a status what became of it when that is stored."""
        ua = import_ua()
        shown = self._shown.get(str(node.Identifier)) if node.NamespaceIndex == self._index else None
        refusal = self._refusal(shown, event, event_id, for_s)
        if refusal or shown is None:
            return ua.StatusCode(getattr(ua.StatusCodes, refusal))
        identifier, before = str(node.Identifier), shown.condition
        self._shown[identifier] = shown._replace(comment=(words, datetime.now(UTC)), user=self._who)
        with self._lock:
            self._requests.append(AlarmCommand(before.asset, before.alarm, event, self._who, words, for_s))

        def is_done() -> bool:
            after = self._shown[identifier].condition
            return (after.state, after.since, after.until) != (before.state, before.since, before.until)

        async def wait() -> None:
            async with self._changed:
                await self._changed.wait_for(is_done)

        try:
            await asyncio.wait_for(wait(), ANSWER_WITHIN_S)
        except TimeoutError:
            return ua.StatusCode(ua.StatusCodes.BadTimeout)
        return ua.StatusCode()

    def _refusal(self, shown: _Shown | None, event: LifecycleEvent, event_id: bytes | None, for_s: float | None) -> str:
        """Return the name of the status of a command that is not handed on; empty: it is."""
        if shown is None:
            return "BadNodeIdUnknown"
        if not self._operate:
            return "BadUserAccessDenied"
        if event_id is not None and event_id[:8] not in shown.event_ids:
            return "BadEventIdUnknown"
        if (shown.condition.state, event) not in TRANSITION_TABLE:
            return REFUSALS.get(event, "BadInvalidState")
        return "BadShelvingTimeOutOfRange" if for_s is not None and not 0.0 < for_s < math.inf else ""

    def take_requests(self) -> list[AlarmCommand]:
        """Return what clients have commanded since the last call."""
        with self._lock:
            requests, self._requests = self._requests, []
        return requests


def _event(shown: _Shown, node: Any, source: Any, types: Mapping[str, Any]) -> Any:
    """Return the event of a condition, with the fields of an AlarmConditionType."""
    from asyncua.common.events import Event

    ua = import_ua()
    condition, kinds = shown.condition, ua.VariantType
    at, two_states = datetime.fromtimestamp(condition.since, UTC), condition.two_states
    is_shelved, severity = condition.state is LifecycleState.SHELVED, SEVERITIES[condition.priority]
    shelving = "TimedShelved" if is_shelved else "Unshelved"
    left_ms = max(0.0, 1e3 * ((condition.until or 0.0) - datetime.now(UTC).timestamp())) if is_shelved else 0.0
    texts = {
        "Message": condition.cause or condition.alarm,
        "Comment": shown.comment[0],
        "ConditionClassName": "MaintenanceConditionClassType",
        "ShelvingState/CurrentState": shelving,
        **{name: words[not two_states[name]] for name, words in TWO_STATES.items()},
    }
    is_silenced = is_shelved or two_states["SuppressedState"] or two_states["OutOfServiceState"]
    fields_of: Mapping[Any, Mapping[str, Any]] = {
        kinds.LocalizedText: {name: ua.LocalizedText(text) for name, text in texts.items()},
        kinds.Boolean: {
            "Retain": condition.state is not LifecycleState.NORMAL,
            "SuppressedOrShelved": is_silenced,
            **{f"{name}/Id": holds for name, holds in two_states.items()},
        },
        kinds.NodeId: {
            "NodeId": node,
            "EventType": types.get(condition.ne107 or "", types[""]),
            "SourceNode": source,
            "ConditionClassId": ua.NodeId(ua.ObjectIds.MaintenanceConditionClassType),
            "BranchId": ua.NodeId(),
            "InputNode": ua.NodeId(),
            "ShelvingState/CurrentState/Id": ua.NodeId(getattr(ua.ObjectIds, f"ShelvedStateMachineType_{shelving}")),
        },
        kinds.DateTime: {"Time": at, "ReceiveTime": at, "Comment/SourceTimestamp": shown.comment[1]},
        kinds.String: {"SourceName": condition.asset, "ConditionName": condition.alarm, "ClientUserId": shown.user},
        kinds.UInt16: {"Severity": severity, "LastSeverity": severity},
        kinds.ByteString: {"EventId": condition.event_id},
        kinds.StatusCode: {"Quality": ua.StatusCode()},
        kinds.Double: {"ShelvingState/UnshelveTime": left_ms},
    }
    event = Event()
    for kind, fields in fields_of.items():
        for name, value in fields.items():
            event.add_property(name, value, kind)
    return event


def _now(status: Mapping[str, Any]) -> float:
    """Return the time of a status [UTC s]: that of its samples, or of this machine for the service itself."""
    return float(status["counted"]["t"]) if "counted" in status else time.time()
