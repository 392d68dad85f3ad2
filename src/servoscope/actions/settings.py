"""What is done about alarms, from the section `[actions]`: webhooks, commands, fault-tolerant changes."""

from __future__ import annotations

import math
import re
from collections import Counter
from pathlib import Path
from typing import Annotated, Literal, Self
from urllib.parse import urlsplit

from pydantic import AfterValidator, Field, field_validator, model_validator

from servoscope.alarms import Event, Priority, State
from servoscope.broker import BrokerSettings
from servoscope.settings import Finite, Positive, Settings, Word

__all__ = [
    "DIAGNOSED",
    "PLACEHOLDERS",
    "ActionSettings",
    "CommandSettings",
    "MessageSettings",
    "RetrySettings",
    "ToleranceSettings",
    "WebhookSettings",
]


def _is_name(value: str) -> str:
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_-]*", value):
        raise ValueError(f"{value!r} is no name for an action: a letter, then letters, digits, _ and -")
    return value


Name = Annotated[str, Field(strict=True), AfterValidator(_is_name)]
Whole = Annotated[int, Field(strict=True, ge=1)]

DIAGNOSED = "diagnosed"  # an event that is none of the life-cycle: the cause of an alarm is known
BELIEVED = 1e3  # ratio to healthy, or its inverse, beyond which a change is not left to a formula
PLACEHOLDERS = ("key", "time", "asset", "alarm", "event", "after", "priority", "quantity", "value", "previous")


class RetrySettings(Settings):
    """How often, and for how long, an action is tried again.

    Parameters
    ----------
    first_s, longest_s
        Wait before the second try, which doubles with each further one, and its bound [s]. Each wait is shortened by
        up to half, by chance, so that what failed together is not tried again together.
    give_up_s
        How old an event may get; then it is given up, which is told and stays in the history.
    """

    first_s: Positive = 1.0
    longest_s: Positive = 900.0
    give_up_s: Positive = 7 * 86400.0


class _Sink(Settings):
    """What webhook and command have in common.

    Parameters
    ----------
    alarms, assets
        Names for which it acts; None: all.
    priorities, events, states
        Which of their transitions: priorities, events of the life-cycle, and states that are entered; None: all. By
        default those that an operator is told: a new alarm, and its return to normal. The event ``diagnosed``, that
        the cause of an alarm is known, is heard where new alarms are.
    timeout_s
        How long one try may take [s].
    """

    alarms: tuple[Word, ...] | None = None
    assets: tuple[Word, ...] | None = None
    priorities: tuple[Priority, ...] | None = None
    events: tuple[Event | Literal["diagnosed"], ...] | None = None
    states: tuple[State, ...] | None = (State.UNACKNOWLEDGED, State.RETURNED, State.LATCHED_UNACKNOWLEDGED)
    timeout_s: Positive = 10.0


class WebhookSettings(_Sink):
    """A POST of the event as JSON.

    Parameters
    ----------
    url
        Where to; http or https.
    secret_env, secret_file
        Where the secret of the signature is: an environment variable, or a file. Without one nothing is signed.
    """

    url: Word
    secret_env: Word | None = None
    secret_file: Word | None = None

    @field_validator("url")
    @classmethod
    def _is_http(cls, value: str) -> str:
        try:
            parts = urlsplit(value)
            good = parts.scheme in ("http", "https") and bool(parts.hostname) and (parts.port is None or parts.port > 0)
        except ValueError:
            good = False
        if not good:
            raise ValueError(f"{value!r} is no address, write http://... or https://...")
        return value

    @model_validator(mode="after")
    def _one_secret(self) -> Self:
        if self.secret_env is not None and self.secret_file is not None:
            raise ValueError("give secret_env or secret_file, not both")
        return self


class CommandSettings(_Sink):
    """A program that is run with the event as JSON on its standard input; no shell has a part in it.

    Parameters
    ----------
    argv
        Program and arguments. An argument that is one of `PLACEHOLDERS` in braces is replaced, whole.
    """

    argv: Annotated[tuple[Word, ...], Field(min_length=1)]

    @field_validator("argv")
    @classmethod
    def _whole_placeholders(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        known = {f"{{{name}}}" for name in PLACEHOLDERS}
        for argument in value:
            if argument in known:
                continue
            if part := next((one for one in known if one in argument), None):
                raise ValueError(f"{argument!r}: a placeholder is an argument of its own, write {part!r} alone")
            if re.fullmatch(r"\{\w+\}", argument):
                raise ValueError(f"{argument!r} is no placeholder, choose from {', '.join(sorted(known))}")
            if "\0" in argument:
                raise ValueError("an argument must not hold a zero byte")
        if value[0] in known:
            raise ValueError("the program must be named, not be a placeholder")
        return value


class MessageSettings(_Sink):
    """The event as JSON, published to an MQTT broker with QoS 1.

    Parameters
    ----------
    broker
        Which one.
    topic
        Where to.
    """

    broker: BrokerSettings
    topic: Annotated[str, Field(strict=True, pattern=r"^[^#+\x00]+$", max_length=1000)]


class ToleranceSettings(Settings):
    """A change of a set-point or a gain that lets the loop live with a fault; off unless told otherwise.

    Parameters
    ----------
    mode
        ``off``; ``recommend``: the change is recorded and told; ``execute``: it is also sent to `sink`.
    sink
        Name of the webhook or command that executes it.
    assets
        For which it is meant.
    fault
        Name of the fault, alone in the diagnosis, that calls for it.
    quantity, kind
        What is changed, as the sink knows it, and whether that is a ``gain`` or a ``set_point``.
    nominal
        Its value while healthy.
    value
        Its value under the fault; or
    exponent
        nominal * ratio^exponent, with the fault's ratio to healthy: -1 makes up for a lost gain.
    min, max
        Bounds of the value.
    max_step
        Largest change at a time; what is beyond waits for the next occasion.
    per_hour
        Most changes within an hour.
    """

    mode: Literal["off", "recommend", "execute"] = "off"
    sink: Word | None = None
    assets: Annotated[tuple[Word, ...], Field(min_length=1)]
    fault: Word
    quantity: Word
    kind: Literal["gain", "set_point"]
    nominal: Finite
    value: Finite | None = None
    exponent: Annotated[Finite, Field(ge=-10.0, le=10.0)] | None = None
    min: Finite
    max: Finite
    max_step: Positive
    per_hour: Whole = 1

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if (self.value is None) == (self.exponent is None):
            raise ValueError("give value or exponent, one of them")
        if not self.min <= self.nominal <= self.max:
            raise ValueError(f"nominal: {self.nominal:g} must lie between min and max")
        if self.value is not None and not self.min <= self.value <= self.max:
            raise ValueError(f"value: {self.value:g} must lie between min and max")
        if self.mode == "execute" and self.sink is None:
            raise ValueError('sink: missing, mode = "execute" needs the name of a webhook or a command')
        return self

    def target(self, ratio: float) -> float:
        """Return the value under a fault of a size, before limits; NaN for a size that nobody believes."""
        if not 1.0 / BELIEVED < ratio < BELIEVED:
            return math.nan
        return self.value if self.value is not None else self.nominal * math.pow(ratio, self.exponent or 0.0)


class ActionSettings(Settings):
    """The section `[actions]`.

    Parameters
    ----------
    retry
        The table `[actions.retry]`.
    webhook, command, mqtt, tolerance
        Tables by name: `[actions.webhook.NAME]` and so on. No name may be used twice.
    """

    retry: RetrySettings = RetrySettings()
    webhook: dict[Name, WebhookSettings] = Field(default_factory=dict)
    command: dict[Name, CommandSettings] = Field(default_factory=dict)
    mqtt: dict[Name, MessageSettings] = Field(default_factory=dict)
    tolerance: dict[Name, ToleranceSettings] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _names(self) -> Self:
        twice = [name for name, count in Counter([*self.webhook, *self.command, *self.mqtt]).items() if count > 1]
        if twice:
            raise ValueError(f"{min(twice)!r} names two of webhook, command and mqtt, rename one")
        for name, one in self.tolerance.items():
            if one.sink is not None and one.sink not in self.sinks:
                raise ValueError(f"tolerance.{name}: sink: no webhook, command or mqtt is called {one.sink!r}")
        return self

    def beside(self, folder: Path) -> ActionSettings:
        """Return the same with the paths of programs and secrets relative to a folder; plain names stay names."""

        def there(path: str) -> str:
            return str(folder / path)

        def hook(one: WebhookSettings) -> WebhookSettings:
            return one if one.secret_file is None else one.model_copy(update={"secret_file": there(one.secret_file)})

        def tool(one: CommandSettings) -> CommandSettings:
            program, *rest = one.argv
            return one.model_copy(update={"argv": (there(program), *rest)}) if "/" in program else one

        webhook = {name: hook(one) for name, one in self.webhook.items()}
        command = {name: tool(one) for name, one in self.command.items()}
        return self.model_copy(update={"webhook": webhook, "command": command})

    @property
    def sinks(self) -> dict[str, WebhookSettings | CommandSettings | MessageSettings]:
        """Webhooks, commands and messages, by name."""
        return {**self.webhook, **self.command, **self.mqtt}
