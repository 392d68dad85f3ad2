"""Messages to values of r, u, y and covariates by asset, as a table ``[sources.NAME.payload]`` says where they are."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from typing import Any

import numpy as np

from servoscope.core.errors import ConfigError, MessageError
from servoscope.service.mapping.influx import parse_lines
from servoscope.service.mapping.paths import (
    ASSET,
    MAX_ROWS,
    MISSING,
    SIGNAL,
    RowPath,
    TextPattern,
    find,
    find_around,
    split_path,
)
from servoscope.service.mapping.settings import PayloadSettings
from servoscope.service.mapping.sparkplug import SparkplugDecoder
from servoscope.service.mqtt.payload import parse_json
from servoscope.service.sources.assembly import SIGNALS
from servoscope.service.sources.block import MAX_TIME_S
from servoscope.service.sources.message import (
    Content,
    Decoder,
    InboxMessage,
    RejectionCounter,
    SignalValue,
    SourceAsset,
)
from servoscope.signals.readers.clock import ZoneOffset

PER_SECOND = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}  # whole: nanoseconds are more than a binary64 counts
MAX_STAMP = 10**30  # beyond any time, in any unit
MAX_NAMES_SHOWN = 8  # names that a message lists
MAX_BAD_ROWS = 100  # of a message that are refused one by one
TASK = "servoscope.service.mapping.rows:try_decoding"
MAX_EXTRA = 1000  # names of a message that are not mapped, of which some are shown
_ALWAYS = frozenset(range(len(SIGNALS)))  # what each sample has; covariates come when they like
Reject = Callable[[str, str, str], None]  # counts what cannot be used: of which asset, of which kind, why


class MessageMapping(Decoder):
    """Reads the messages of some assets, given with their sample rates [Hz].

    Raises ConfigError if the settings do not say of which asset a message is, or name one that there is not.
    """

    def __init__(self, settings: PayloadSettings, rates: Mapping[str, float], reject: Reject) -> None:
        self.settings, self._rates, self._reject = settings, rates, reject
        self.covariates = tuple(settings.fields.covariates)
        self.block_s, self.hold_s, self.is_dated = settings.block, settings.hold_s, bool(settings.time)
        self.trial = TASK, settings, dict(rates)
        if strange := set(settings.called) - set(rates):
            raise ConfigError(f"payload.called: there is no asset {min(strange)!r} of this source")
        if not settings.names_assets and len(rates) > 1:
            raise ConfigError(
                "payload: nothing says of which asset a message is, write {asset} into topics, rows or match"
            )
        self._assets = {settings.called.get(name, name): name for name in rates}
        if len(self._assets) < len(rates):
            raise ConfigError("payload.called: two assets of this source are called the same")
        self._only = next(iter(rates), "") if not settings.names_assets else ""
        self._topics = [TextPattern(topic) for topic in settings.topics]
        self._rows = RowPath(settings.rows)
        self._match = [(split_path(path), TextPattern(text)) for path, text in settings.match.items()]
        self._good = [
            (split_path(path), good_values if isinstance(good_values, list) else [good_values])
            for path, good_values in settings.good.items()
        ]
        self._time = [(split_path(path), unit) for path, unit in settings.time.items()]
        zone = settings.time_zone
        self._zones = {name: ZoneOffset(zone) for name in rates} if zone is not None else {}  # each has a last time
        self._fields = [split_path(field) for field in settings.fields.all]
        self._by_name = {name: k for k, name in enumerate(settings.fields.all)} if settings.has_signal_names else {}
        self._value = split_path(settings.value)
        scale = settings.scale
        self._scale = (scale.r, scale.u, scale.y, *(scale.covariates.get(name, 1.0) for name in self.covariates))
        self._signals = (*SIGNALS, *self.covariates)
        self._known_names = ((SIGNAL, self._by_name), (ASSET, self._assets))
        self._sparkplug = SparkplugDecoder(self._is_mapped) if settings.decoder == "sparkplug" else None
        self._senders: dict[str, dict[str, str]] = {}  # by asset, what its last topic said
        # where nothing but r, u and y is expected: the table of all of them, and what else may stand in it
        parents = {field[:-1] for field in self._fields}
        self._table = next(iter(parents)) if len(parents) == 1 and not self._by_name else None
        beside = (*self._time, *self._match, *self._good)
        self._expected = {str(field[-1]) for field in self._fields} | {str(path[0]) for path, _ in beside}

    @classmethod
    def of_assets(
        cls, settings: PayloadSettings, assets: Mapping[str, SourceAsset], rejections: RejectionCounter
    ) -> MessageMapping:
        """Return the mapping for the assets of a source."""
        return cls(settings, {name: asset.loop.sample_rate for name, asset in assets.items()}, rejections.add)

    def addresses(self, *, everyone: bool = False) -> list[str]:
        """Return what to subscribe to: the topics of these assets, as far as topics tell them, or of `everyone`."""
        values = {} if everyone else {ASSET: frozenset(self._assets)}
        if self._by_name:
            values[SIGNAL] = frozenset(self._by_name)
        return sorted(set().union(*(topic.filters(values) for topic in self._topics)))

    def requests(self) -> list[tuple[str, bytes]]:
        """Return the messages that ask nodes of Sparkplug for their births."""
        return self._sparkplug.rebirth_requests() if self._sparkplug is not None else []

    def _is_mapped(self, metric: str) -> bool:
        """Return whether a metric of Sparkplug may be a signal of an asset, by its name."""
        names: dict[str, str] = {}
        for path, pattern in self._match:
            if path == ("name",):
                if (bound := pattern.match(metric)) is None:
                    return False
                names |= bound
        return all(name not in names or names[name] in known for name, known in self._known_names)

    def find_asset(self, topic: str) -> str:
        """Return the asset that a topic tells, or the only one; empty: it tells none."""
        names = self._match_topic(topic) or {}
        return self._assets.get(names.get(ASSET, ""), "") or self._only

    def _match_topic(self, topic: str) -> dict[str, str] | None:
        """Return what the names of the first pattern that fits stand for."""
        return next((match for text_pattern in self._topics if (match := text_pattern.match(topic)) is not None), None)

    def decode(self, message: InboxMessage) -> Content:
        """Return the values of a message; what has no time stamp was measured when it came."""
        return self.read(message.address, message.content, time.time() - (time.monotonic() - message.at))

    def read(self, topic: str, message: bytes, received_at: float) -> Content:
        """Return what a message holds that came at `received_at` [UTC s].

        A row that cannot be used is counted and left out; raises MessageError if nothing of the message can be read.
        """
        names = self._match_topic(topic)
        if names is None:
            raise MessageError("unknown topic", f"{topic[:100]!r} fits none of the topics of this source")
        tree, gone = self._decode(names, message)
        values: dict[str, list[SignalValue]] = {}
        extra, complete, rows, bad = set[str](), True, 0, 0
        for around, bound in self._rows.rows(tree):
            rows += 1
            if rows > MAX_ROWS or bad > MAX_BAD_ROWS:
                why = f"{MAX_ROWS} rows" if rows > MAX_ROWS else f"{bad} rows that cannot be used"
                self._reject(self.find_asset(topic), "rows", f"all that is behind {why} of a message is left out")
                break
            row_names = self._match_row(around, {**names, **bound})
            asset = self._only if row_names is not None else ""
            if row_names is not None and ASSET in row_names:
                asset = self._assets.get(row_names[ASSET], "")
            if row_names is None or not asset:
                if len(extra) < MAX_EXTRA:
                    called = (row_names or {}).get(ASSET)
                    extra.add("row that matches nothing" if called is None else f"row of {called!r}")
                continue
            self._senders[asset] = names
            try:
                signals = self._read_signals(around, row_names, extra)
                if signals:
                    made = self._read_values(around, signals, received_at, asset)
                    values.setdefault(asset, []).extend(made)
                complete = complete and len(signals.keys() & _ALWAYS) == len(SIGNALS)
            except MessageError as error:
                bad += 1
                self._reject(asset, error.kind, str(error))
        if not rows and not gone and self._sparkplug is None:
            raise MessageError("keys", f"no rows at {self.settings.rows!r}, {describe_keys(tree)}")
        if extra and not self.settings.ignore_extra:
            text = ", ".join(sorted(extra)[:MAX_NAMES_SHOWN])[:200]
            self._reject(self.find_asset(topic), "extra", f"is not mapped: {text} (ignore_extra = true leaves it out)")
        return Content(values, gone, complete and bool(values))

    def _decode(self, names: dict[str, str], message: bytes) -> tuple[Any, frozenset[str]]:
        if self._sparkplug is not None:
            rows = self._sparkplug.decode(names, message)
            gone = frozenset[str]()
            if self._sparkplug.is_dead(names, message):
                sender = {key: value for key, value in names.items() if key != "message"}
                gone = frozenset(asset for asset, last in self._senders.items() if sender.items() <= last.items())
            return rows, gone
        if self.settings.decoder == "influx":
            return parse_lines(message), frozenset()
        try:
            return parse_json(message), frozenset()
        except (ValueError, RecursionError) as error:
            raise MessageError("not a block", f"no JSON: {' '.join(str(error).split())[:100]}") from None

    def _match_row(self, around: list[Any], names: dict[str, str]) -> dict[str, str] | None:
        """Return what all names of a row stand for; None where its texts are others."""
        for path, pattern in self._match:
            text = find_around(around, path)
            if not isinstance(text, str | int) or (bound := pattern.match(str(text))) is None:
                return None
            names |= bound
        return names

    def _read_signals(self, around: list[Any], names: dict[str, str], extra: set[str]) -> dict[int, Any]:
        """Return the signals of a row as they stand there: numbers, or lists."""
        if self._by_name:
            signal = self._by_name.get(names.get(SIGNAL, ""))
            if signal is None:
                extra.add(f"signal {names.get(SIGNAL, '')!r}")
                return {}
            value = find(around[0], self._value)
            if value is MISSING:
                raise MessageError("keys", f"no {self.settings.value!r}, {describe_keys(around[0])}")
            return {signal: value}
        table = find(around[0], self._table) if self._table is not None else None
        if isinstance(table, dict):
            extra.update(f"field {key!r}" for key in table.keys() - self._expected)
        values = {k: find(around[0], path) for k, path in enumerate(self._fields)}
        signals = {k: value for k, value in values.items() if value is not MISSING}
        if not signals:
            wanted = ", ".join(self.settings.fields.all)
            raise MessageError("keys", f"none of {wanted} is there, {describe_keys(around[0])}")
        return signals

    def _read_values(
        self, around: list[Any], signals: dict[int, Any], received_at: float, asset: str
    ) -> Iterable[SignalValue]:
        stamps = self._read_times(around, received_at, asset)
        good = all(find_around(around, path) in contents for path, contents in self._good)
        if not any(isinstance(signal, list) for signal in signals.values()) and isinstance(stamps, float):
            return [SignalValue(k, stamps, self._number(k, signal, good)) for k, signal in signals.items()]
        lengths = {
            len(signal) if isinstance(signal, list) else 1
            for k, signal in signals.items()
            if self._is_sampled(k, signal)
        }
        if len(lengths) > 1:
            raise MessageError("lengths", f"lists of {' and '.join(map(str, sorted(lengths)))} values in one row")
        n = lengths.pop() if lengths else 1
        if isinstance(stamps, float):
            step = self.settings.step_s or 1.0 / self._rates[asset]
            first = stamps if self.settings.stamp == "first" else stamps - (n - 1) * step
            stamps = [first + k * step for k in range(n)]
        if len(stamps) != n:
            raise MessageError("lengths", f"{len(stamps)} time stamps, {n} samples")
        return [
            SignalValue(k, t, self._number(k, value, good))
            for k, signal in signals.items()
            for t, value in zip(
                stamps, signal if isinstance(signal, list) else [signal], strict=self._is_sampled(k, signal)
            )
        ]

    def _is_sampled(self, signal: int, value: Any) -> bool:
        """Return whether a signal has a value of each sample; a covariate may have one for all, of the first."""
        return signal in _ALWAYS or isinstance(value, list)

    def _read_times(self, around: list[Any], received_at: float, asset: str) -> float | list[float]:
        """Return the time stamp of a row of an asset, or of each of its samples [UTC s]."""
        if not self._time:
            return received_at
        total: float | list[float] = 0.0
        for path, unit in self._time:
            stamp = find_around(around, path)
            if stamp is MISSING:
                where = ".".join(map(str, path))
                raise MessageError("times", f"no time stamp at {where!r}, {describe_keys(around[0])}")
            if isinstance(stamp, list):
                many = [self._parse_time(entry, unit, asset) for entry in stamp]
                before = total if isinstance(total, list) else [total] * len(many)
                if len(before) != len(many):
                    raise MessageError("lengths", "time stamps of different numbers")
                total = [time + other for time, other in zip(before, many, strict=True)]
            else:
                moment = self._parse_time(stamp, unit, asset)
                total = [other + moment for other in total] if isinstance(total, list) else total + moment
        if not all(0.0 <= t < MAX_TIME_S for t in (total if isinstance(total, list) else [total])):
            raise MessageError("times", "a time stamp outside of the years 1970 to 9999: is its unit right?")
        return total

    def _parse_time(self, value: Any, unit: str, asset: str) -> float:
        if unit != "iso" and not (type(value) is int and abs(value) < MAX_STAMP):
            return _parse_number(value, "time stamp") / PER_SECOND[unit]
        if unit != "iso":
            return float(value / PER_SECOND[unit])
        try:
            moment = datetime.fromisoformat(value)
            if moment.tzinfo is not None:
                return moment.timestamp()
            written, zone = moment.replace(tzinfo=UTC).timestamp(), self._zones.get(asset)
            return written if zone is None else written - float(zone.offsets(np.array([written]))[0])
        except (TypeError, ValueError, OverflowError):
            raise MessageError("times", f"{str(value)[:40]!r} is no date") from None

    def _number(self, signal: int, value: Any, good: bool) -> float:
        if value is None or not good:
            return float("nan")
        return _parse_number(value, self._signals[signal]) * self._scale[signal]


def describe_keys(tree: Any) -> str:
    """Return what there is instead, in words."""
    if isinstance(tree, dict):
        return f"only {', '.join(sorted(map(str, tree))[:MAX_NAMES_SHOWN])[:200] or 'an empty table'}"
    return f"only a list of {len(tree)}" if isinstance(tree, list) else f"only {type(tree).__name__} {str(tree)[:40]}"


def _parse_number(value: Any, what: str) -> float:
    """Return a number, or that of a text: long integers, and whatever templates put into quotes, come as texts."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise MessageError("wrong type", f"{what}: {str(value)[:40]!r} is no number")
    try:
        return float(value)
    except (ValueError, OverflowError):
        raise MessageError("wrong type", f"{what}: {str(value)[:40]!r} is no number that a computer can hold") from None


def try_decoding(
    _: Callable[[str], None], settings: PayloadSettings, rates: Mapping[str, float], topic: str, content: bytes
) -> None:
    """Decode a message in a worker's process: it matters only that this comes to an end."""
    with suppress(MessageError):
        MessageMapping(settings, rates, lambda *_: None).read(topic, content, time.time())
