"""What the interface answers of notifications: where they go, and what became of the newest one."""

from __future__ import annotations

from servoscope.web.schemas.responses import ApiResponse


class LastDelivery(ApiResponse):
    """The newest notification for an outlet; `outcome` is empty before its first attempt."""

    t: float
    event: str
    attempts: int
    outcome: str


class NotificationOutlet(ApiResponse):
    """A webhook, command, message or mail of the service file."""

    name: str
    kind: str  # webhook, command, mqtt or email
    target: str
    may_test: bool  # not what changes a machine
    last: LastDelivery | None


class NotificationOutlets(ApiResponse):
    """All of them."""

    outlets: list[NotificationOutlet]
