"""Alarm lists of operators' stations, by OPC UA clients of two stacks: each shows what events leave in it."""

from __future__ import annotations

import json
import signal
import subprocess
from pathlib import Path
from typing import Any

from oidc_provider import found_node

SCRIPT = Path(__file__).parent / "opcua_server" / "alarm_list.js"
Row = dict[str, Any]  # of an alarm: its condition, conditionName, eventId, activeState, ackedState and so on


class NodeAlarmList:
    """That of node-opcua, a process of its own; it connects again by itself."""

    def __init__(self, url: str) -> None:
        words = [found_node(SCRIPT), str(SCRIPT), url]
        self._process = subprocess.Popen(words, stdin=-1, stdout=-1, stderr=subprocess.DEVNULL, text=True)
        self.ask("counts")  # it has connected then

    def ask(self, do: str, **words: Any) -> Any:
        """Return what a command is answered."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps({"do": do, **words}) + "\n")
        self._process.stdin.flush()
        for line in self._process.stdout:
            if line.startswith(">"):  # the rest is the library's
                return json.loads(line[1:])
        raise AssertionError("the client has ended")

    def rows(self) -> list[Row]:
        """Return the alarms that it shows."""
        return list(self.ask("list"))

    def acknowledge(self, row: Row, comment: str) -> str:
        """Acknowledge an alarm of its list; return the name of the status."""
        return str(self.ask("acknowledge", condition=row["condition"], eventId=row["eventId"], comment=comment))

    def pause(self) -> None:
        """Let it do nothing, as on a machine that is busy."""
        self._process.send_signal(signal.SIGSTOP)

    def go_on(self) -> None:
        """End the pause."""
        self._process.send_signal(signal.SIGCONT)

    def close(self) -> None:
        """End it."""
        self._process.kill()
        self._process.communicate()


class PythonAlarmList:
    """That of asyncua's client."""

    def __init__(self, url: str) -> None:
        from asyncua import ua
        from asyncua.sync import Client

        self._ua, self._client, self._rows = ua, Client(url, timeout=30.0), dict[str, Row]()
        try:
            self._client.connect()
        except OSError:
            self._client.tloop.stop()  # its thread, which would go on
            raise
        subscription = self._client.create_subscription(100, self)
        subscription.subscribe_events(ua.ObjectIds.Server, ua.ObjectIds.AlarmConditionType)
        number = ua.Variant(subscription.aio_obj.subscription_id, ua.VariantType.UInt32)
        kind = self._client.get_node(ua.ObjectIds.ConditionType)
        kind.call_method(ua.NodeId(ua.ObjectIds.ConditionType_ConditionRefresh), number)

    def event_notification(self, event: Any) -> None:
        """Take an event."""
        if getattr(event, "NodeId", None) is None:  # one around a refresh
            return
        fields = vars(event)
        row = {
            "condition": event.NodeId.to_string(), "eventId": event.EventId.hex(), "message": event.Message.Text,
            "conditionName": event.ConditionName, "severity": event.Severity, "comment": event.Comment.Text,
            "activeState": fields["ActiveState/Id"], "ackedState": fields["AckedState/Id"],
            "confirmedState": fields["ConfirmedState/Id"], "shelvingState": fields["ShelvingState/CurrentState"].Text,
        }  # fmt: skip
        self._rows[row["condition"]] = row
        if not event.Retain:
            del self._rows[row["condition"]]

    def status_change_notification(self, status: Any) -> None:
        """Take the end of a subscription."""

    def rows(self) -> list[Row]:
        """Return the alarms that it shows."""
        return list(self._rows.values())

    def value(self, node: str) -> Any:
        """Return the value of a variable."""
        return self._client.get_node(node).read_value()

    def acknowledge(self, row: Row, comment: str) -> str:
        """Acknowledge an alarm of its list; return the name of the status."""
        ua, node = self._ua, self._client.get_node(row["condition"])
        method = ua.NodeId(ua.ObjectIds.AcknowledgeableConditionType_Acknowledge)
        words = ua.Variant(bytes.fromhex(row["eventId"])), ua.Variant(ua.LocalizedText(comment))
        try:
            node.call_method(method, *words)
        except ua.UaStatusCodeError as error:
            return type(error).__name__
        return "Good"

    def close(self) -> None:
        """End it."""
        self._client.disconnect()
