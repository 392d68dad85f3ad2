"""What is done about alarms, from the section `[actions]`: webhooks, commands, mails, fault-tolerant changes."""

from __future__ import annotations

import math
import re
from collections import Counter
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, field_validator, model_validator

from servoscope.core.settings import Finite, NonEmptyStr, Positive, Settings
from servoscope.service.alarms import LifecycleEvent, LifecycleState, Priority
from servoscope.service.config_types import HttpUrl, SecretSettings, matching
from servoscope.service.mqtt.client import BrokerSettings
from servoscope.service.network import NetworkSettings, TlsSettings, apply_network

NAME_REMEDY = "{value!r} is no name for an action: a letter, then letters, digits, _ and -"
ActionName = Annotated[str, Field(strict=True), matching("[A-Za-z][A-Za-z0-9_-]*", NAME_REMEDY)]
PositiveInt = Annotated[int, Field(strict=True, ge=1)]

DIAGNOSIS_EVENT = "diagnosed"  # an event that is none of the life-cycle: the cause of an alarm is known
TEST_EVENT = "test"  # another: somebody tries whether notifications arrive
MAX_RATIO = 1e3  # ratio to healthy, or its inverse, beyond which a change is not left to a formula
PLACEHOLDERS = ("key", "time", "asset", "alarm", "event", "after", "priority", "link", "quantity", "value", "previous")


SINKS = ("webhook", "command", "mqtt", "email")  # keys of the tables of those that are told
SINK_NAMES = f"{', '.join(SINKS[:-1])} and {SINKS[-1]}"


class RetrySettings(Settings):
    """How often, and for how long, an action is tried again."""

    # wait before the second attempt, which doubles with each further one, and its bound [s]; jitter shortens each by
    # up to half, so that what failed together is not tried again together
    first_s: Positive = 1.0
    longest_s: Positive = 900.0
    # how old an event may get; then it is given up, which is logged and stays in the history
    give_up_s: Positive = 7 * 86400.0


class SinkSettings(Settings):
    """Which events are sent, and how long an attempt may take."""

    once_per_episode: ClassVar[bool] = False  # whether an alarm that comes again before it was normal is no news

    alarms: tuple[NonEmptyStr, ...] | None = None  # alarms, assets: names that concern it; None: all
    assets: tuple[NonEmptyStr, ...] | None = None
    # priorities, events, states: which of their transitions, the states being those entered; None: all. By default a
    # new alarm, and its return to normal. The event ``diagnosed``, that the cause of an alarm is known, is sent where
    # new alarms are.
    priorities: tuple[Priority, ...] | None = None
    events: tuple[LifecycleEvent | Literal["diagnosed"], ...] | None = None
    states: tuple[LifecycleState, ...] | None = (
        LifecycleState.UNACKNOWLEDGED,
        LifecycleState.RETURNED,
        LifecycleState.LATCHED_UNACKNOWLEDGED,
    )
    timeout_s: Positive = 10.0  # how long one attempt may take [s]
    address: Annotated[str, Field(strict=True, pattern=r"^https?://\S+$")] | None = None  # of the pages, for links


class WebhookSettings(TlsSettings, SecretSettings, SinkSettings):
    """A POST of the event as JSON; over https the other side has to prove its identity."""

    url: HttpUrl  # where to; http or https

    @model_validator(mode="after")
    def _check_certificates(self) -> Self:
        if self.has_certificates and not self.url.lower().startswith("https:"):
            raise ValueError("url: certificates are given, but it is no https://")
        if self.key_file is not None and self.cert_file is None:
            raise ValueError("cert_file: missing, key_file is the key of it")
        return self


class CommandSettings(SinkSettings):
    """A program that is run with the event as JSON on its standard input; no shell has a part in it."""

    # program and arguments. An argument that is one of `PLACEHOLDERS` in braces is replaced, whole.
    argv: Annotated[tuple[NonEmptyStr, ...], Field(min_length=1)]

    @field_validator("argv")
    @classmethod
    def _check_placeholders(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        known = {f"{{{name}}}" for name in PLACEHOLDERS}
        for argument in set(value) - known:
            if part := next((placeholder for placeholder in known if placeholder in argument), None):
                raise ValueError(f"{argument!r}: a placeholder is an argument of its own, write {part!r} alone")
            if re.fullmatch(r"\{\w+\}", argument):
                raise ValueError(f"{argument!r} is no placeholder, choose from {', '.join(sorted(known))}")
            if "\0" in argument:
                raise ValueError("an argument must not hold a zero byte")
        if value[0] in known:
            raise ValueError("the program must be named, not be a placeholder")
        return value

    def program(self, folder: Path) -> str:
        """Return what is run: a path is relative to a folder, a plain name stays one."""
        return str(folder / self.argv[0]) if "/" in self.argv[0] else self.argv[0]


class MqttMessageSettings(SinkSettings):
    """The event as JSON, published to an MQTT broker with QoS 1."""

    broker: BrokerSettings
    topic: Annotated[str, Field(strict=True, pattern=r"^[^#+\x00]+$", max_length=1000)]


MailAddress = Annotated[str, Field(strict=True, pattern=r"^[^@\s,;<>]+@[^@\s,;<>]+$", max_length=254)]


class EmailSettings(TlsSettings, SecretSettings, SinkSettings):
    """A mail in plain text, one for each episode of an alarm; the secret is the password of `user`."""

    once_per_episode: ClassVar[bool] = True

    host: NonEmptyStr  # host, port: the server that takes mails; None: 465 with ``tls``, else 587
    port: Annotated[int, Field(strict=True, ge=1, le=65535)] | None = None
    encryption: Literal["starttls", "tls", "none"] = "starttls"  # the server has to prove its identity
    user: NonEmptyStr | None = None  # who we are to it; None: it asks nobody
    sender: MailAddress
    to: Annotated[tuple[MailAddress, ...], Field(min_length=1)]
    per_hour: PositiveInt = 20  # most mails within an hour; what is beyond waits, and comes as one
    states: tuple[LifecycleState, ...] | None = (LifecycleState.UNACKNOWLEDGED,)

    @model_validator(mode="after")
    def _check_user(self) -> Self:
        if (self.user is None) == self.has_secret:
            raise ValueError("user: give it with secret_env or secret_file, or neither")
        if self.encryption == "none" and (self.has_secret or self.has_certificates):
            raise ValueError('encryption: "none" would send the password in the clear, write "starttls" or "tls"')
        return self


Sink = WebhookSettings | CommandSettings | MqttMessageSettings | EmailSettings


class FaultToleranceSettings(Settings):
    """A change of a set-point or a gain with which the loop tolerates a fault; off by default."""

    # ``off``; ``recommend``: the change is recorded; ``execute``: it is also sent to `sink`
    mode: Literal["off", "recommend", "execute"] = "off"
    sink: NonEmptyStr | None = None  # name of the webhook or command that executes it
    assets: Annotated[tuple[NonEmptyStr, ...], Field(min_length=1)]  # for which it is meant
    fault: NonEmptyStr  # name of the fault, alone in the diagnosis, that calls for it
    # quantity, kind: what is changed, as the sink knows it, and whether that is a ``gain`` or a ``set_point``
    quantity: NonEmptyStr
    kind: Literal["gain", "set_point"]
    nominal: Finite  # its value while healthy
    value: Finite | None = None  # its value under the fault; or
    # nominal * ratio^exponent, with the fault's ratio to healthy: -1 makes up for a lost gain
    exponent: Annotated[Finite, Field(ge=-10.0, le=10.0)] | None = None
    min: Finite  # min, max: bounds of the value
    max: Finite
    max_step: Positive  # largest change at a time; what is beyond waits for the next occasion
    per_hour: PositiveInt = 1  # most changes within an hour

    @model_validator(mode="after")
    def _check_consistency(self) -> Self:
        if (self.value is None) == (self.exponent is None):
            raise ValueError("give value or exponent, one of them")
        if not self.min <= self.nominal <= self.max:
            raise ValueError(f"nominal: {self.nominal:g} must lie between min and max")
        if self.value is not None and not self.min <= self.value <= self.max:
            raise ValueError(f"value: {self.value:g} must lie between min and max")
        if self.mode == "execute" and self.sink is None:
            raise ValueError('sink: missing, mode = "execute" needs the name of a webhook or a command')
        return self

    def target_value(self, ratio: float) -> float:
        """Return the value under a fault of a size, before limits; NaN for a size that is not credible."""
        if not 1.0 / MAX_RATIO < ratio < MAX_RATIO:
            return math.nan
        return self.value if self.value is not None else self.nominal * math.pow(ratio, self.exponent or 0.0)


class ActionSettings(Settings):
    """The section `[actions]`."""

    retry: RetrySettings = RetrySettings()  # the table `[actions.retry]`
    # tables by name: `[actions.webhook.NAME]` and so on; no name may be used twice
    webhook: dict[ActionName, WebhookSettings] = Field(default_factory=dict)
    command: dict[ActionName, CommandSettings] = Field(default_factory=dict)
    mqtt: dict[ActionName, MqttMessageSettings] = Field(default_factory=dict)
    email: dict[ActionName, EmailSettings] = Field(default_factory=dict)
    tolerance: dict[ActionName, FaultToleranceSettings] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _check_names(self) -> Self:
        twice = [name for name, count in Counter(chain(*(getattr(self, key) for key in SINKS))).items() if count > 1]
        if twice:
            raise ValueError(f"{min(twice)!r} names two of {SINK_NAMES}, rename one")
        for name, action in self.tolerance.items():
            if action.sink is not None and (action.sink in self.email or action.sink not in self.sinks):
                raise ValueError(f"tolerance.{name}: sink: no webhook, command or mqtt is called {action.sink!r}")
        return self

    def with_network(self, network: NetworkSettings) -> ActionSettings:
        """Return the same with rules for those that have none of their own."""
        brokers = apply_network({name: sink.broker for name, sink in self.mqtt.items()}, network)
        mqtt = {name: sink.model_copy(update={"broker": brokers[name]}) for name, sink in self.mqtt.items()}
        webhook, email = apply_network(self.webhook, network), apply_network(self.email, network)
        return self.model_copy(update={"webhook": webhook, "mqtt": mqtt, "email": email})

    def with_service_name(self, before: str, name: str) -> Self:
        """Return them with another name of the service, where sinks are limited to its own alarms."""

        def renamed(sinks: dict[str, Any]) -> dict[str, Any]:
            return {
                key: sink.model_copy(
                    update={"assets": tuple(name if asset == before else asset for asset in sink.assets)}
                )
                if sink.assets
                else sink
                for key, sink in sinks.items()
            }

        return self.model_copy(update={key: renamed(getattr(self, key)) for key in SINKS})

    @property
    def executing(self) -> set[str | None]:
        """Names of the sinks that change a machine, and are not tried therefore."""
        return {action.sink for action in self.tolerance.values()}

    @property
    def sinks(self) -> dict[str, Sink]:
        """Webhooks, commands, messages and mails, by name."""
        return {name: sink for key in SINKS for name, sink in getattr(self, key).items()}
