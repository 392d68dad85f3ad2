"""What has to be delivered: entries of an outbox, each with a key that identifies its event."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

from servoscope.core.messages import message, render
from servoscope.service.actions.settings import DIAGNOSIS_EVENT, TEST_EVENT, ActionSettings, RetrySettings
from servoscope.service.alarms import AlarmState, AlarmTransition, LifecycleState, Notification, Priority, alarm_kind

QUIET_STATES = (  # in which nobody has to answer an alarm
    LifecycleState.NORMAL,
    LifecycleState.SHELVED,
    LifecycleState.SUPPRESSED,
    LifecycleState.OUT_OF_SERVICE,
)


@dataclass(frozen=True)
class OutboxEntry:
    """One event for one webhook, command, broker or mail, until it is delivered; times are (epoch, s).

    It is written in the same transaction as the transition that it reports, and removed, or put off, after a
    delivery: so it is delivered at least once, and again after a crash in between. Receivers recognise a repetition
    by the key.
    """

    key: str  # idempotency key: the same for every attempt at the same event, and for no other
    sink: str  # name of the webhook, command, message or mail
    event: dict[str, Any]  # what is sent; plain values, ready for JSON
    created: float
    due: float  # when it is to be tried next
    attempts: int = 0  # so far

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return asdict(self)


@dataclass(frozen=True)
class DeliveryAttempt:
    """How one attempt went."""

    entry: OutboxEntry  # as it was before
    delivered: bool  # whether the receiver has accepted it
    detail: str  # the answer, in one line
    retry_entry: OutboxEntry | None = None  # replaces the entry in the outbox; None: it is delivered or given up


def transition_entries(
    settings: ActionSettings,
    transition: AlarmTransition,
    priority: Priority,
    now: float,
    details: Mapping[str, Any] | None = None,
) -> tuple[OutboxEntry, ...]:
    """Return the entries for one transition: one for each sink that it concerns.

    `now` (epoch, s) is of the clock that `deliver` is given: in a replay that of the transition is another. `details`
    is sent along: the diagnosis, consequence and operator action of the alarm.
    """
    if transition.before is transition.after:
        return ()
    # the time, for an asset that begins anew, or in another store, counts its transitions from 1 again
    key = transition.asset, transition.alarm, transition.sequence, repr(transition.time)
    event = {**transition.to_dict(), "priority": priority, "details": dict(details or {})}
    return _alarm_entries(settings, key, event, transition.after, now)


def diagnosis_entries(
    settings: ActionSettings,
    alarm: AlarmState,
    priority: Priority,
    time: float,
    now: float,
    summary: str,
    details: Mapping[str, Any],
) -> tuple[OutboxEntry, ...]:
    """Return the entries for a full diagnosis, whose window ends at `time` (epoch, s).

    There is one for each sink that is told when the alarm is new.
    """
    state = alarm.state.value  # a diagnosis does not change it
    event = {
        "time": time, "asset": alarm.asset, "alarm": alarm.alarm, "sequence": alarm.sequence, "before": state,
        "after": state, "event": DIAGNOSIS_EVENT, "cause": summary, "who": "system", "priority": priority,
        "details": dict(details),
    }  # fmt: skip
    key = alarm.asset, alarm.alarm, DIAGNOSIS_EVENT, repr(time)
    return _alarm_entries(settings, key, event, LifecycleState.UNACKNOWLEDGED, now)


def _alarm_entries(
    settings: ActionSettings, key: tuple[str | int, ...], event: dict[str, Any], state: LifecycleState, now: float
) -> tuple[OutboxEntry, ...]:
    """Return an entry for each sink whose filters an event passes."""
    entries = []
    for name, sink in settings.sinks.items():
        filters: tuple[tuple[tuple[str, ...] | None, str], ...] = (
            (sink.alarms, alarm_kind(event["alarm"])),
            (sink.assets, event["asset"]),
            (sink.priorities, event["priority"]),
            (sink.events, event["event"]),
            (sink.states, state),
        )
        again = event["before"] not in QUIET_STATES and state is LifecycleState.UNACKNOWLEDGED
        if sink.once_per_episode and again:
            continue
        if all(accepted is None or value in accepted for accepted, value in filters):
            entries.append(_entry(name, key, event, now))
    return tuple(entries)


def flood_entries(settings: ActionSettings, notice: Notification, now: float) -> tuple[OutboxEntry, ...]:
    """Return the entries for the start or end of a flood: one per sink that is not limited to some alarms or assets."""
    key = notice.kind, repr(notice.time)
    event = {"event": notice.kind, "time": notice.time, "counted": notice.counted, "peak": notice.peak}
    sinks = [name for name, sink in settings.sinks.items() if sink.alarms is sink.assets is sink.events is None]
    return tuple(_entry(name, key, event, now) for name in sinks)


def trial_entry(sink: str, service: str, who: str, now: float) -> OutboxEntry:
    """Return the entry with which somebody tries a sink; it is attempted once."""
    cause = render(message("service.trial", who=who))
    event = {
        "time": now, "asset": service, "alarm": TEST_EVENT, "before": LifecycleState.NORMAL.value,
        "after": LifecycleState.NORMAL.value, "event": TEST_EVENT, "cause": cause, "who": who, "priority": "low",
    }  # fmt: skip
    return _entry(sink, (TEST_EVENT, repr(now)), event, now)


def _entry(sink: str, parts: tuple[str | int, ...], event: dict[str, Any], now: float) -> OutboxEntry:
    key = idempotency_key(sink, *parts)
    return OutboxEntry(key, sink, {"key": key, **event}, created=now, due=now)


def idempotency_key(*parts: str | int) -> str:
    """Return an idempotency key: 32 hexadecimal digits."""
    return hashlib.sha256("\0".join(str(part) for part in parts).encode()).hexdigest()[:32]


def schedule_retry(retry: RetrySettings, entry: OutboxEntry, now: float, min_wait_s: float = 0.0) -> OutboxEntry | None:
    """Return the entry for its next attempt, or None where it is given up: exponential backoff with equal jitter.

    The jitter is computed from the key, so that it is the same whenever it is computed. The receiver may ask for a
    minimum wait.
    """
    attempts = entry.attempts + 1
    longest = min(retry.longest_s, retry.first_s * 2.0 ** min(attempts - 1, 60))
    jitter = int(idempotency_key(entry.key, attempts), 16) / 16.0**32
    due = now + max(longest * (1.0 - 0.5 * jitter), min(min_wait_s, retry.longest_s))
    return None if due - entry.created > retry.give_up_s else replace(entry, due=due, attempts=attempts)
