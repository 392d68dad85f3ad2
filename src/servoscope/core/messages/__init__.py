"""The catalogue of messages: records carry keys and values, and the text that people read is rendered here.

The catalogue of a language is one TOML file of templates, ``<language>.toml``. A template is a format string whose
format specifications are Python's or one of `FORMATS` and `JOINS`::

    [diagnosis]
    candidate = "{names:plus} ({probability:probability})"

    render(message("diagnosis.candidate", names=("pump", "leakage"), probability=0.86))

A value that is None leaves nothing, so an optional part of a sentence is a message of its own, or None. Words that are
no sentences, headings and names of faults, are looked up by their English in the table ``word`` of another language:
where its template says ``{name!w}``, and by `translate`.
"""

from __future__ import annotations

import contextlib
import functools
import os
import re
import string
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextvars import ContextVar
from datetime import UTC, datetime
from importlib.resources import files
from typing import Annotated, Any
from zoneinfo import ZoneInfo

from pydantic import BaseModel, BeforeValidator, ConfigDict, PlainSerializer, field_validator

from servoscope.core.number_format import format_rough, format_share, format_short

__all__ = [
    "FORMATS",
    "JOINS",
    "Message",
    "MessageField",
    "MessageText",
    "add_words",
    "catalogue",
    "clock_of",
    "count_words",
    "current_language",
    "current_zone",
    "format_moment",
    "languages",
    "message",
    "read_messages",
    "render",
    "set_language",
    "speak",
    "text_message",
    "translate",
    "translate_range",
]

FOLDER = files("servoscope.core.messages")
SETTING = "SERVOSCOPE_LANGUAGE"
WORD_SOURCES: list[Callable[[str], Mapping[str, str]]] = []
PLAIN_TEXT = "text"  # the key of a message that is its text: from outside, or of a file of an earlier version


@functools.cache
def languages() -> tuple[str, ...]:
    """Return the languages that there is a catalogue of."""
    names = sorted(traversable.name for traversable in FOLDER.iterdir() if traversable.name.endswith(".toml"))
    return tuple(name.removesuffix(".toml") for name in names)


def set_language(name: str) -> None:
    """Let this process and those that it starts speak a language, as ``de``.

    Raises ValueError if there is no catalogue of it.
    """
    global LANGUAGE
    if name not in languages():
        raise ValueError(f"there is no language {name!r}, choose from {', '.join(languages())}")
    LANGUAGE = os.environ[SETTING] = name


# Of what is rendered without another one being named; de_DE is German too, and what nobody translated English.
LANGUAGE = next((candidate for candidate in languages() if candidate == os.environ.get(SETTING, "")[:2].lower()), "en")


_spoken: ContextVar[str | None] = ContextVar("spoken", default=None)
_zone: ContextVar[ZoneInfo | None] = ContextVar("zone", default=None)


def current_language() -> str:
    """Return the language of what is rendered here and now: that of `speak`, else of the process."""
    return _spoken.get() or LANGUAGE


def current_zone() -> ZoneInfo | None:
    """Return the time zone of the reader of `speak`; None: dates are in UTC and say so."""
    return _zone.get()


@contextlib.contextmanager
def speak(name: str, zone: str | None = None) -> Iterator[None]:
    """Speak another language than the process for a while, in this thread or task and those that it starts.

    `zone`: the reader's time zone, as ``Europe/Berlin``; one that this machine does not know is not used.
    """
    region = None
    with contextlib.suppress(ValueError, OSError):
        region = ZoneInfo(zone) if zone else None
    before, clock = _spoken.set(name), _zone.set(region)
    try:
        yield
    finally:
        _spoken.reset(before)
        _zone.reset(clock)


_began: ContextVar[float | None] = ContextVar("began", default=None)


@contextlib.contextmanager
def clock_of(began: float | None) -> Iterator[None]:
    """Write moments as dates, those of a recording that began then [s since 1970], in this thread for a while."""
    before = _began.set(began)
    try:
        yield
    finally:
        _began.reset(before)


def format_moment(seconds: float) -> str:
    """Return a moment of a recording [s since its beginning], with its date where `clock_of` gives the beginning."""
    began = _began.get()
    if began is None:
        return f"{seconds:.1f} s"
    date = datetime.fromtimestamp(round(began + seconds, 1), UTC)
    return render(message("date.after_start", date=f"{date:%Y-%m-%d %H:%M:%S.%f}"[:-5], seconds=seconds))


class Message(BaseModel):
    """A sentence, or a part of one: a key of the catalogue with the values that its template names."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    key: str  # section and name in the catalogue: ``diagnosis.healthy``
    values: dict[str, Any] = {}  # numbers, words, messages, sequences of these; None for a part that is left out

    @field_validator("values", mode="before")
    @classmethod
    def _read_nested(cls, values: Mapping[str, Any]) -> dict[str, Any]:
        """Turn messages that come from JSON back into messages."""
        return {name: _read_value(value) for name, value in values.items()}

    def __str__(self) -> str:
        return render(self)

    def __eq__(self, other: object) -> bool:
        # by text: of a record that was written and read back only the text is left
        return isinstance(other, Message) and str(self) == str(other)

    def __hash__(self) -> int:
        return hash(str(self))


def message(key: str, **values: Any) -> Message:
    """Return the message of a key of the catalogue with values."""
    return Message(key=key, values=values)


def _read_value(value: Any) -> Any:
    if isinstance(value, Mapping) and "key" in value:
        return Message(key=value["key"], values=value.get("values", {}))
    if isinstance(value, (list, tuple)):
        return tuple(_read_value(item) for item in value)
    return value


def text_message(text: str) -> Message:
    """Return a message that is its text: of an error, or of a file written before messages had keys."""
    return message(PLAIN_TEXT, text=text)


# Of a record's field: plain text is accepted too.
MessageField = Annotated[
    Message, BeforeValidator(lambda given: text_message(given) if isinstance(given, str) else given)
]

# The same, written to JSON and files as its text, and read back as that text.
MessageText = Annotated[MessageField, PlainSerializer(str, return_type=str)]


def read_messages(written: Any, **texts: str) -> Any:
    """Return the written fields of a record with its messages, or sequences of them, restored.

    `texts` gives, by field, the key under which the rendered text stands beside it. The text replaces the message where
    there is none (files of earlier versions) and where this version cannot render it (files of later ones).
    """
    if not isinstance(written, Mapping):
        return written
    fields = dict(written)
    for field, key in texts.items():
        text = fields.pop(key, None)
        if text is not None:
            fields[field] = _restore(fields.get(field), text)
    return fields


def _restore(given: Any, text: Any) -> Any:
    if isinstance(text, (list, tuple)):
        parts = given if isinstance(given, (list, tuple)) and len(given) == len(text) else [None] * len(text)
        return tuple(_restore(part, words) for part, words in zip(parts, text, strict=True))
    try:
        restored = Message.model_validate(given)
        render(restored)
    except (ValueError, LookupError, TypeError, AttributeError):
        return text
    return restored


def _format_utc(value: float) -> str:
    zone = _zone.get()
    try:
        if zone is not None:  # which the page names
            return f"{datetime.fromtimestamp(value, zone):%Y-%m-%d %H:%M:%S}"
        return f"{datetime.fromtimestamp(value, UTC):%Y-%m-%d %H:%M:%S} UTC"
    except (OverflowError, OSError, ValueError):  # a clock that was set to what is in no calendar
        return f"{value:.0f} s"


FORMATS: Mapping[str, Callable[[Any], str]] = {
    "rough": format_rough,
    "short": format_short,
    "percent": lambda value: f"{100.0 * value:.3g} %",
    "share": format_share,
    "probability": lambda value: "> 99.9 %" if value > 0.999 else f"{100.0 * value:.3g} %",
    "utc": _format_utc,
    "moment": format_moment,
    "first_moment": lambda value: format_moment(value).removesuffix(" s"),  # whose unit follows the second one
    "capitalised": lambda value: str(value)[:1].upper() + str(value)[1:],
}
JOINS: Mapping[str, str] = {
    "list": ", ",
    "semicolon": "; ",
    "plus": " + ",
    "sentences": " ",
    "and": "join.and",
    "or": "join.or",
}


class _Renderer(string.Formatter):
    def __init__(self, language: str) -> None:
        self._language = language

    def convert_field(self, value: Any, conversion: str | None) -> Any:
        if conversion == "w":
            several = isinstance(value, (list, tuple))
            return [self._word(item) for item in value] if several else self._word(value)
        return None if value is None else super().convert_field(value, conversion)

    def _word(self, value: Any) -> Any:
        if isinstance(value, Message) and value.key == PLAIN_TEXT:  # of a plant
            value = str(value)
        return translate(value, self._language) if isinstance(value, str) else value

    def format_field(self, value: Any, spec: str) -> str:
        if value is None:
            return ""
        if isinstance(value, Message):
            value = render(value, self._language)
        if isinstance(value, (list, tuple)):
            return self._join([self.format_field(item, "") for item in value], spec or "list")
        if spec.startswith("#"):
            return count_words(value, spec[1:], self._language)
        if spec in FORMATS:
            return FORMATS[spec](value)
        return str(super().format_field(value, spec))

    def _join(self, texts: list[str], spec: str) -> str:
        if spec not in ("and", "or"):
            return JOINS[spec].join(texts)
        if len(texts) < 2:
            return "".join(texts)
        return template(JOINS[spec], self._language).format(first=", ".join(texts[:-1]), last=texts[-1])


def render(given: Message, language: str | None = None) -> str:
    """Return a message as text.

    Raises
    ------
    KeyError
        If the catalogue has no such key, or the template names a value that the message has not.
    """
    if given.key == PLAIN_TEXT:
        return str(given.values["text"])
    language = language or current_language()
    return _Renderer(language).vformat(template(given.key, language), (), given.values)


def say(key: str, **values: Any) -> str:
    """Return a message of the catalogue as text, in the current language."""
    return render(message(key, **values))


def count_words(count: float | str, noun: str, language: str | None = None) -> str:
    """Return a number of things, 1 row or 2 rows; `noun` is a name of the section ``count`` of the catalogue."""
    singular, _, several = render(message(f"count.{noun}", count=count), language).partition("|")
    return singular if str(count) == "1" else several


def template(key: str, language: str) -> str:
    """Return the template of a key; in English where the language has none."""
    text = catalogue(language).get(key)
    return text if text is not None else catalogue("en")[key]


def translate(words: str, language: str | None = None) -> str:
    """Return a heading or a name in a language; as it is in English, and where there is no translation.

    A unit in brackets behind it stays.
    """
    language = language or current_language()
    if language == "en":
        return words
    known = catalogue(language)
    for spelling in (words, words.replace(" ", "_")):  # names of faults are written either way
        if f"word.{spelling}" in known:
            return known[f"word.{spelling}"]
    if " + " in words:  # a pair of faults
        return " + ".join(translate(word, language) for word in words.split(" + "))
    kind, of, joint = words.partition(" of ")
    if of and f"word.{kind}" in known:  # of a joint of an arm
        return render(message("quantity.of_joint", kind=kind, joint=joint), language)
    joint, dot, parameter = words.partition(".")
    if dot and f"word.{parameter}" in known:
        return f"{joint}: {known[f'word.{parameter}']}"
    what, bracket, unit = words.partition(" [")
    return known.get(f"word.{what}", what) + bracket + unit


def translate_range(cell: str) -> str:
    """Return what stands in a cell of a table, 1.19 to 1.20 for example, in the language of this process."""
    to = translate("to")
    return cell if to == "to" else re.sub(r"(?<=[\d%s]) to (?=[\d−×-])", f" {to} ", cell)


@functools.cache
def catalogue(language: str = "en") -> Mapping[str, str]:
    """Return the templates of a language by key."""
    own = tomllib.loads(FOLDER.joinpath(f"{language}.toml").read_text(encoding="utf-8"))
    words = {f"word.{english}": text for source in WORD_SOURCES for english, text in source(language).items()}
    return {**words, **dict(_flatten(own))}


def add_words(source: Callable[[str], Mapping[str, str]]) -> None:
    """Let a function return further words of a language by their English; where it knows a word itself, that counts."""
    WORD_SOURCES.append(source)
    catalogue.cache_clear()


def _flatten(table: Mapping[str, Any], prefix: str = "") -> Iterable[tuple[str, str]]:
    for name, value in table.items():
        if isinstance(value, str):
            yield prefix + name, value
        else:
            yield from _flatten(value, f"{prefix}{name}.")
