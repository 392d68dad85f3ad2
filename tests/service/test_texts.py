"""Hostile texts at the gate of store, log, mail and page; rows that a database refuses; commands that end a service."""

from __future__ import annotations

import io
import json
import logging
import math
from pathlib import Path
from typing import Any

import halls
import pytest
import sqlalchemy as sa

from servoscope.core.texts import MAX_TEXT_CHARS, clean_text, clean_texts
from servoscope.service.actions.mail import compose_mail
from servoscope.service.actions.settings import EmailSettings
from servoscope.service.assets.asset import Asset
from servoscope.service.assets.records import StepResult
from servoscope.service.log import LOGGER, log, set_up_logging
from servoscope.service.store import Batch, Store, tables
from servoscope.service.store.queries import query_history
from servoscope.web.errors import problem_response

SURROGATES = ("\ud800", "\udfff", "\udcff", "\ud83d", "\ude00\ud83d")  # none has its partner; \udcff: a byte of a name
UNSAFE = ("\0", "\1", "\b", "\r", "\x1b[2J", "\x7f", "\x85", "\x9b", "\u2028", "\u2029", "\u202e", "\u2066", "\ufeff")
LONG = ("x" * 1001, "\0" * 1000, "\U0001f600" * 5000, "\udc80" * 999, "\u00e4" * 10**5)
ODD = (
    "",
    "'; DROP TABLE audit --",
    "%s %(x)s :x",
    "\\",
    "\\x00",
    '"',
    "{}",
    "null",
    "<b>",
    "\n\t",
    "a\r\nb",
    "\U0001f600",
)
MIXED = ("press\0\ud800.csv", "\udce9t\udce9.csv", "NaN", "../../etc", "\u0000\u202egnp.exe")
HOSTILE = (*SURROGATES, *UNSAFE, *LONG, *ODD, *MIXED)
assert len(HOSTILE) == 40
VALUES: dict[type, Any] = {sa.Double: 1.0, sa.BigInteger: 1, sa.Integer: 1, sa.LargeBinary: b""}


def filled(table: sa.Table, number: int, text: str) -> dict[str, Any]:
    """Return a row of a table with the text in each of its columns that takes one, and apart from others by number."""
    row: dict[str, Any] = {}
    for column in table.c:
        if isinstance(column.type, tables.CleanText):
            row[column.name] = f"{number} {text}"
        elif isinstance(column.type, sa.JSON):
            row[column.name] = {"text": text, text: [text, {"text": text}, 1.5]}
        elif column.name == "contents":  # JSON of the service's own: names of assets that its file may have
            row[column.name] = "[]"
        else:
            row[column.name] = next(value for kind, value in VALUES.items() if isinstance(column.type, kind))
    key = next(iter(table.primary_key)).name
    return row if isinstance(row[key], str) else {**row, key: number}


def test_every_column_takes_every_text(store: Store) -> None:
    raw = [
        column.name
        for table in tables.METADATA.tables.values()
        for column in table.c
        if isinstance(column.type, sa.Text)
    ]
    assert raw == ["contents"]
    rows = {
        name: [filled(table, i, text) for i, text in enumerate(HOSTILE)]
        for name, table in tables.METADATA.tables.items()
    }
    assert store.write(Batch(rows={name: list(own) for name, own in rows.items()}), "hall", 1) == []
    for name, table in tables.METADATA.tables.items():
        stored = [row for row in store.fetch(sa.select(table)) if row.get("key") not in ("schema", "commit of hall")]
        assert len(stored) == len(HOSTILE)
        for row in stored:
            json.dumps(row, ensure_ascii=False, default=str).encode()  # no lone surrogate is left
        longest = {column.name: column.type.longest for column in table.c if isinstance(column.type, tables.CleanText)}
        for column, most in longest.items():
            expected = sorted(clean_text(row[column], most) for row in rows[name])
            assert sorted(row[column] for row in stored) == expected and max(map(len, expected)) <= most
        for column in (column.name for column in table.c if isinstance(column.type, sa.JSON)):
            sent = [clean_texts(row[column]) for row in rows[name]]
            assert all(row[column] in sent for row in stored)


@pytest.mark.parametrize("text", HOSTILE)
def test_a_clean_text_is_safe_short_and_stays_as_it_is(text: str) -> None:
    safe = clean_text(text)
    assert len(safe) <= MAX_TEXT_CHARS and safe == clean_text(safe)
    safe.encode()
    assert all(character.isprintable() or character in "\n\t" for character in safe)
    assert text not in ODD or safe == text.replace("\r\n", "\n")


def test_log_mail_and_page_take_every_text() -> None:
    stream, before = io.StringIO(), (LOGGER.handlers[:], LOGGER.level, LOGGER.propagate)
    settings = EmailSettings.model_validate(
        {"host": "mail.example", "sender": "a@example.org", "to": ["b@example.org"]}
    )
    try:
        set_up_logging("info", stream)
        for text in HOSTILE:
            log("info", text, file=text, more=[{text: text}])
            event = {"event": "raised", "asset": text, "alarm": text, "priority": "high", "after": "x", "cause": text}
            compose_mail("1", [{**event, "time": 0.0, "service": text}], settings).as_bytes()
            assert json.loads(problem_response(422, text, "/", [{"loc": text, "msg": text}]).body)["status"] == 422
    finally:
        LOGGER.handlers[:], LOGGER.level, LOGGER.propagate = before
        logging.getLogger("psycopg").handlers.clear()
    lines = stream.getvalue().splitlines()
    assert len(lines) == len(HOSTILE)
    for line in lines:
        json.dumps(json.loads(line), ensure_ascii=False).encode()


def test_a_row_that_the_store_refuses_is_set_aside_and_the_others_are_stored(store: Store) -> None:
    good = {"asset": "press", "number": 1, "t": 0.0, "statistic": 0.25, "level": 0.5, "residual": []}
    bad = [{**good, "number": 2, "t": None}, {**good, "number": 2**70}, {**good, "statistic": "none"}, good]
    batch = Batch()
    batch.rows["residuals"] = [good, *bad, {**good, "asset": "lift"}]
    batch.rows["audit"] = [{"at": 0.0, "who": "me", "asset": "lift", "what": "note", "document": {"t": math.nan}}]
    refused = store.write(batch, "hall", 1)
    stored = {row["asset"] for row in query_history(store, "residuals")}
    assert stored == {"press", "lift"} and store.last_commit("hall") == 1
    named = [row for row in query_history(store, "audit") if row["what"] == "row set aside"]
    assert len(named) == len(refused) >= 3 and all(row["document"]["why"] for row in named)
    assert {row["asset"] for row in named} == {"press"} and {row["document"]["table"] for row in named} == {"residuals"}


def test_a_command_that_fails_is_refused_and_one_that_ended_the_service_is_not_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    halls.files(tmp_path)
    config = halls.hall(tmp_path, "hall")
    service = halls.service_of(config)
    asked = [
        service.store.add_command("ann\0", name, "fault", "acknowledge", reason="\0\ud800")
        for name in ("press", "lift")
    ]
    service.store.begin_commands(service.store.pending_commands()[:1])

    def execute(asset: Asset, alarm: str, command: object) -> StepResult:
        assert asset.name == "lift", "the command that was under way is executed once more"
        raise ZeroDivisionError(f"{command}")

    monkeypatch.setattr(Asset, "execute", execute)
    service.run()
    store = Store.open(str(tmp_path / "hall.sqlite"))
    outcomes = [store.command_outcome(number) for number in asked]
    store.close()
    assert [one and one.accepted for one in outcomes] == [False, False]
    assert outcomes[0] and "ended while" in outcomes[0].refusal
    assert outcomes[1] and "ZeroDivisionError" in outcomes[1].refusal
