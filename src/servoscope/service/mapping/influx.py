r"""Lines of InfluxDB's line protocol: ``measurement,tag=text field=1.5,other=2i 1700000000000000000``.

Source: InfluxData (2024), InfluxDB v2 documentation, "Line protocol". ``\`` before a comma, a blank or an equals sign
takes away its meaning; a backslash before anything else is itself.
"""

from __future__ import annotations

import re
from typing import Any

from servoscope.core.errors import MessageError
from servoscope.service.mapping.paths import MAX_ROWS

KEY = r"(?:[^\\,=\s]|\\.)+"
TEXT = r'"(?:[^"\\]|\\.)*"'
LINE = re.compile(
    rf"(?P<name>(?:[^\\,\s]|\\.)+)(?P<tags>(?:,{KEY}={KEY})*) +"
    rf"(?P<fields>{KEY}=(?:{TEXT}|[^\s,\"]+)(?:,{KEY}=(?:{TEXT}|[^\s,\"]+))*)(?: +(?P<time>-?\d+))?[ \r]*(?:\n|\Z)",
    re.DOTALL,
)
TAG = re.compile(rf",({KEY})=({KEY})", re.DOTALL)
FIELD = re.compile(rf"({KEY})=({TEXT}|[^\s,\"]+)", re.DOTALL)
BLANK = re.compile(r"(?:[ \t]*(?:#[^\n]*)?\r?\n|[ \t]+\Z)*")
ESCAPE = re.compile(r"\\([,= ])")
TRUE, FALSE = {"t", "T", "true", "True", "TRUE"}, {"f", "F", "false", "False", "FALSE"}


def parse_lines(message: bytes) -> list[dict[str, Any]]:
    """Return each line as a table: name, tags, fields, and timestamp where there is one; raises MessageError.

    Lines behind `MAX_ROWS` are not read.
    """
    try:
        text = message.decode()
    except UnicodeDecodeError:
        raise MessageError("not a block", "no text in UTF-8, and so no line protocol") from None
    rows, at = list[dict[str, Any]](), _skip(text, 0)
    while at < len(text) and len(rows) <= MAX_ROWS:
        match = LINE.match(text, at)
        if match is None:
            raise MessageError("not a block", f"no line protocol: {text[at : at + 60]!r}")
        fields = {_plain(key): _parse_value(value) for key, value in FIELD.findall(match["fields"])}
        tags = {_plain(key): _plain(value) for key, value in TAG.findall(match["tags"])}
        row: dict[str, Any] = {"name": _plain(match["name"]), "tags": tags, "fields": fields}
        if match["time"] is not None:
            row["timestamp"] = int(match["time"][:25])
        rows.append(row)
        at = _skip(text, match.end())
    return rows


def _skip(text: str, at: int) -> int:
    match = BLANK.match(text, at)
    return at if match is None else match.end()


def _plain(text: str) -> str:
    return ESCAPE.sub(r"\1", text)


def _parse_value(text: str) -> Any:
    if text.startswith('"'):
        return text[1:-1]
    if text in TRUE or text in FALSE:
        return text in TRUE
    try:
        return int(text[:-1]) if text[-1] in "iu" else float(text)
    except ValueError:
        raise MessageError("not a block", f"{text[:40]!r} is no value of the line protocol") from None
