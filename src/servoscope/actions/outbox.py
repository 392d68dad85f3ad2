"""What has to be delivered: rows for an outbox, each with a key that says which event it is."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

from servoscope.actions.settings import (
    DIAGNOSED,
    ActionSettings,
    CommandSettings,
    MessageSettings,
    RetrySettings,
    WebhookSettings,
)
from servoscope.alarms import AlarmState, Notice, Priority, State, Transition

__all__ = ["Delivery", "Outgoing", "outgoing", "outgoing_diagnosis", "outgoing_flood"]


@dataclass(frozen=True)
class Outgoing:
    """One event for one webhook, command or broker, until it is delivered.

    It is written in the same transaction as the transition that it tells of, and taken out, or put off, after a
    delivery: so it is delivered at least once, and again after a crash in between. Receivers know a second time by
    the key.

    Parameters
    ----------
    key
        Idempotency key: the same for every try of the same event, and for no other.
    sink
        Name of the webhook or command.
    event
        What it is told; plain values, ready for JSON.
    created, due
        When it was made, and when it is to be tried next (epoch, s).
    attempts
        Number of tries so far.
    """

    key: str
    sink: str
    event: dict[str, Any]
    created: float
    due: float
    attempts: int = 0

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return asdict(self)


@dataclass(frozen=True)
class Delivery:
    """How one try went.

    Parameters
    ----------
    key, sink, time, attempt
        What was tried, when (epoch, s), and the how-manieth try it was.
    delivered
        Whether the receiver has taken it.
    detail
        What came back, in one line.
    again
        What takes the row's place in the outbox; None: nothing, it is delivered or given up.
    """

    key: str
    sink: str
    time: float
    attempt: int
    delivered: bool
    detail: str
    again: Outgoing | None = None

    @property
    def given_up(self) -> bool:
        """Whether it will never be delivered; to be told."""
        return not self.delivered and self.again is None


def outgoing(
    settings: ActionSettings,
    transition: Transition,
    priority: Priority,
    now: float,
    details: Mapping[str, Any] | None = None,
) -> tuple[Outgoing, ...]:
    """Return the rows for one transition: one for each webhook and command that it concerns.

    Parameters
    ----------
    settings
        What is done about alarms.
    transition
        What happened.
    priority
        Of the alarm.
    now
        Time (epoch, s), of the clock that `deliver` is given: in a replay that of the transition is another.
    details
        What else receivers are told, ready for JSON: the diagnosis, consequence and operator action of the alarm.
    """
    rows = []
    for name, sink in settings.sinks.items():
        told = transition.asset, transition.alarm, transition.event, transition.after
        if transition.before is not transition.after and _concerns(sink, priority, *told):
            # the time, for an asset that begins anew, or in another store, counts its transitions from 1 again
            key = key_of(name, transition.asset, transition.alarm, transition.sequence, repr(transition.time))
            event = {"key": key, **transition.to_dict(), "priority": priority, "details": dict(details or {})}
            rows.append(Outgoing(key, name, event, created=now, due=now))
    return tuple(rows)


def outgoing_diagnosis(
    settings: ActionSettings,
    alarm: AlarmState,
    priority: Priority,
    time: float,
    now: float,
    summary: str,
    details: Mapping[str, Any],
) -> tuple[Outgoing, ...]:
    """Return the rows for a full diagnosis: one for each sink that is told when the alarm is new.

    Parameters
    ----------
    settings, priority, now, details
        As for `outgoing`.
    alarm
        Whose cause was diagnosed.
    time
        End of the window that was diagnosed (epoch, s).
    summary
        What the diagnosis says.
    """
    rows = []
    for name, sink in settings.sinks.items():
        if _concerns(sink, priority, alarm.asset, alarm.alarm, DIAGNOSED, State.UNACKNOWLEDGED):
            key = key_of(name, alarm.asset, alarm.alarm, DIAGNOSED, repr(time))
            event = {
                "key": key,
                "time": time,
                "asset": alarm.asset,
                "alarm": alarm.alarm,
                "sequence": alarm.sequence,
                "before": alarm.state.value,  # it changes nothing about the alarm
                "after": alarm.state.value,
                "event": DIAGNOSED,
                "cause": summary,
                "who": "system",
                "priority": priority,
                "details": dict(details),
            }
            rows.append(Outgoing(key, name, event, created=now, due=now))
    return tuple(rows)


def outgoing_flood(settings: ActionSettings, notice: Notice, now: float) -> tuple[Outgoing, ...]:
    """Return the rows for the beginning or the end of a flood: for each sink that is not kept to some alarms or assets.

    Parameters
    ----------
    settings
        What is done about alarms.
    notice
        ``flood_begins`` or ``flood_ends``.
    now
        As for `outgoing`.
    """
    rows = []
    for name, sink in settings.sinks.items():
        if sink.alarms is sink.assets is sink.events is None:
            key = key_of(name, notice.kind, repr(notice.time))
            event = {
                "key": key,
                "event": notice.kind,
                "time": notice.time,
                "counted": notice.counted,
                "peak": notice.peak,
            }
            rows.append(Outgoing(key, name, event, created=now, due=now))
    return tuple(rows)


def key_of(*parts: str | int) -> str:
    """Return an idempotency key: 32 hexadecimal digits."""
    return hashlib.sha256("\0".join(str(part) for part in parts).encode()).hexdigest()[:32]


def put_off(retry: RetrySettings, row: Outgoing, now: float, at_least: float = 0.0) -> Outgoing | None:
    """Return the row for its next try, or None where it is given up: exponential backoff with equal jitter.

    The chance in it is drawn from the key, so that it is the same whenever it is computed.

    Parameters
    ----------
    retry
        How often to try.
    row
        What has just failed.
    now
        Time (epoch, s).
    at_least
        How long the receiver asks to wait [s].
    """
    attempts = row.attempts + 1
    longest = min(retry.longest_s, retry.first_s * 2.0 ** min(attempts - 1, 60))
    chance = int(key_of(row.key, attempts), 16) / 16.0**32
    due = now + max(longest * (1.0 - 0.5 * chance), min(at_least, retry.longest_s))
    return None if due - row.created > retry.give_up_s else replace(row, due=due, attempts=attempts)


def _concerns(
    sink: WebhookSettings | CommandSettings | MessageSettings,
    priority: Priority,
    asset: str,
    alarm: str,
    event: str,
    state: State,
) -> bool:
    wanted: tuple[tuple[tuple[str, ...] | None, str], ...] = (
        (sink.alarms, alarm),
        (sink.assets, asset),
        (sink.priorities, priority),
        (sink.events, event),
        (sink.states, state),
    )
    return all(names is None or one in names for names, one in wanted)
