"""What a plant's messages look like: topics, rows, fields, times, as the service file names them; known forms."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from servoscope.core.settings import Finite, NonEmptyStr, NonNegative, Positive, Settings
from servoscope.models.columns import TimeZone
from servoscope.service.config_types import Seconds, matching
from servoscope.service.mapping.paths import ASSET, SIGNAL, RowPath, TextPattern

TimeUnit = Literal["s", "ms", "us", "ns", "iso"]
FORMS: dict[str, dict[str, Any]] = {  # keys that a form brings; those of the service file take their place
    "thingsboard": {
        "topics": ("v1/gateway/telemetry",),
        "rows": "{asset}",
        "fields": {"r": "values.r", "u": "values.u", "y": "values.y"},
        "time": {"ts": "ms"},
    },
    "telegraf": {
        "match": {"tags.asset": "{asset}"},
        "fields": {"r": "fields.r", "u": "fields.u", "y": "fields.y"},
        "time": {"timestamp": "s"},
    },
    "influx": {
        "decoder": "influx",
        "match": {"tags.asset": "{asset}"},
        "fields": {"r": "fields.r", "u": "fields.u", "y": "fields.y"},
        "time": {"timestamp": "ns"},
    },
    "sparkplug": {
        "decoder": "sparkplug",
        "topics": ("spBv1.0/{group}/{message}/{node}/{asset}", "spBv1.0/{group}/{message}/{node}"),
        "match": {"name": "{signal}"},
        "value": "value",
        "time": {"timestamp": "ms"},
        "hold_s": 60.0,  # a node reports changes, and its death
        "ignore_extra": True,  # births name whatever a node has
    },
}


TOPIC_REMEDY = "write a name in braces for a level that may be anything: plant/{{line}}/{{asset}}/data"
Topic = Annotated[str, Field(strict=True, min_length=1, max_length=500), matching(r"[^+#\0]*", TOPIC_REMEDY)]
Text = Annotated[str, Field(strict=True)]


class SignalNames(Settings):
    """Where r, u and y are: paths in a row; where a message has one value of one signal, what {signal} is for them."""

    r: NonEmptyStr = "r"
    u: NonEmptyStr = "u"
    y: NonEmptyStr = "y"
    covariates: dict[NonEmptyStr, NonEmptyStr] = Field(default_factory=dict)  # the same by name, as in the loop file

    @property
    def all(self) -> tuple[str, ...]:
        """Those of r, u and y, and of the covariates."""
        return self.r, self.u, self.y, *self.covariates.values()


class SignalScales(Settings):
    """Factors that turn the plant's units into those of the loop."""

    r: Finite = 1.0
    u: Finite = 1.0
    y: Finite = 1.0
    covariates: dict[NonEmptyStr, Finite] = Field(default_factory=dict)


class PayloadSettings(Settings):
    """The table ``[sources.NAME.payload]``."""

    # keys of a known form: thingsboard, telegraf, influx, sparkplug; none: all keys are given
    form: Literal["thingsboard", "telegraf", "influx", "sparkplug"] | None = None
    decoder: Literal["json", "influx", "sparkplug"] = "json"  # how bytes become a tree of tables and lists
    # patterns of topics; {asset} and {signal} mean something, other names in braces stand for any level
    topics: Annotated[tuple[Topic, ...], Field(min_length=1)]
    rows: Text = (
        ""  # path to the rows; ``*``: all elements, ``{asset}``: all keys; empty: the message is one, or a list
    )
    match: dict[NonEmptyStr, NonEmptyStr] = Field(
        default_factory=dict
    )  # texts of a row, and the patterns they must have
    fields: SignalNames = SignalNames()  # paths of r, u, y in a row: numbers, or lists of as many samples
    value: Text = ""  # path of the value, where {signal} says of which signal it is
    # paths of the time stamp, with their units: s, ms, us, ns, iso; several are added; none: when the message came
    time: dict[NonEmptyStr, TimeUnit] = Field(default_factory=dict)
    time_zone: TimeZone | None = None  # of ``iso`` times that are local, as Europe/Berlin; None: they are UTC
    stamp: Literal["first", "last"] = "first"  # which sample of a list a single time stamp is of
    step_s: Positive | None = None  # time between two samples of a list with one time stamp [s]; None: that of the loop
    good: dict[NonEmptyStr, Any] = Field(default_factory=dict)  # what tells that a value is good: paths and contents
    scale: SignalScales = SignalScales()
    called: dict[NonEmptyStr, NonEmptyStr] = Field(default_factory=dict)  # by asset, what the plant calls it
    hold_s: Annotated[NonNegative, Field(le=3600.0)] = 0.0  # how long a value holds where only changes are sent [s]
    block: Seconds = 1.0  # length of the blocks that are made of the samples [s]
    ignore_extra: Annotated[bool, Field(strict=True)] = False  # whether what is not mapped is left out without a word

    @model_validator(mode="before")
    @classmethod
    def _complete(cls, data: Any) -> Any:
        form = FORMS.get(data["form"]) if isinstance(data, Mapping) and isinstance(data.get("form"), str) else None
        return data if form is None else {**form, **data}

    @model_validator(mode="after")
    def _check_names(self) -> Self:
        inside = self._row_names
        signal = [SIGNAL in inside or SIGNAL in TextPattern(topic).names for topic in self.topics]
        if any(signal) and not all(signal):
            raise ValueError("topics: {signal} must stand in all of them, or in none")
        own, carried = self.fields.all[:3], self.fields.all[3:]
        for names in (self.fields.all,) if any(signal) else (own, carried):  # of an arm r, u, y stand under both
            if len(set(names)) < len(names):
                raise ValueError("fields: r, u and y must be different ones, and so must covariates")
        if strange := set(self.scale.covariates) - set(self.fields.covariates):
            raise ValueError(f"scale.covariates: {min(strange)} does not stand under fields.covariates")
        if self.value and not any(signal):
            raise ValueError("value: leave it out, or say by {signal} in topics, rows or match of which signal it is")
        return self

    def carries(self, covariate: str) -> bool:
        """Return whether the plant's messages carry a covariate."""
        return covariate in self.fields.covariates

    @property
    def _row_names(self) -> frozenset[str]:
        """Names in the path to the rows, and in the patterns of their texts."""
        return RowPath(self.rows).names.union(*(TextPattern(pattern).names for pattern in self.match.values()))

    @property
    def _names(self) -> frozenset[str]:
        return self._row_names.union(*(TextPattern(topic).names for topic in self.topics))

    @property
    def has_signal_names(self) -> bool:
        """Whether a row is one value of one signal, which topic, rows or match name."""
        return SIGNAL in self._names

    @property
    def names_assets(self) -> bool:
        """Whether messages tell of which asset they are."""
        return ASSET in self._names
