"""What the interface answers of notifications: where they go, and what became of the newest one."""

from __future__ import annotations

from servoscope.web.schemas.responses import ApiResponse, JsonObject


class NotificationOutlet(ApiResponse):
    """A webhook, command, message or mail of the service file."""

    name: str
    kind: str  # webhook, command, mqtt or email
    target: str
    may_test: bool  # not what changes a machine
    last: JsonObject | None  # newest notification: t, event, attempts, and outcome, empty before the first attempt


class NotificationOutlets(ApiResponse):
    """All of them."""

    outlets: list[NotificationOutlet]
