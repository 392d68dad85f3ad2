"""The catalogue of messages: complete, without leftovers, and all that a second language needs."""

from __future__ import annotations

import ast
import json
import re
import string
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest

import servoscope as ss
from golden.results import FOLDER
from servoscope.core import messages
from servoscope.core.messages import (
    JOINS,
    Message,
    catalogue,
    count_words,
    message,
    read_messages,
    render,
    text_message,
)
from servoscope.core.number_format import format_rough
from servoscope.diagnosis.result import Diagnosis, DiagnosisWarning, Mimic

SOURCES = sorted((Path(__file__).parents[2] / "src" / "servoscope").rglob("*.py"))
TEMPLATES = sorted((Path(__file__).parents[2] / "src" / "servoscope").rglob("templates/*.html"))


@cache
def strings() -> frozenset[str]:
    """All literal strings of the source code, and the keys that templates of pages say."""
    in_templates = (
        key for path in TEMPLATES for key in re.findall(r'say\("([\w.]+)"', path.read_text(encoding="utf-8"))
    )
    trees = (ast.parse(path.read_text(encoding="utf-8")) for path in SOURCES)
    constants = (node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Constant))
    return frozenset((*(node.value for node in constants if isinstance(node.value, str)), *in_templates))


@cache
def calls() -> tuple[tuple[str, ast.Call], ...]:
    """All calls of `message`, and of `say` in pages, with where they are."""
    found = []
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("message", "say"):
                found.append((f"{path.name}:{node.lineno}", node))
    return tuple(found)


def keys_of(call: ast.Call) -> list[str]:
    """The keys that a call may use, as far as they are literal: one, or those of a condition."""
    given = call.args[0]
    branches = [given.body, given.orelse] if isinstance(given, ast.IfExp) else [given]
    return [str(each.value) for each in branches if isinstance(each, ast.Constant)]


def fields(template: str) -> Iterator[str]:
    """The values that a template names, those in its format specifications included."""
    for _, name, spec, _ in string.Formatter().parse(template):
        if name is not None:
            yield name
            yield from fields(spec or "")


def test_every_key_is_in_the_catalogue() -> None:
    assert [(at, key) for at, call in calls() for key in keys_of(call) if key not in catalogue()] == []
    assert len(calls()) > 50


def test_every_entry_is_used() -> None:
    prefixes = tuple(
        str(each.values[0].value)
        for _, call in calls()
        for each in ast.walk(call.args[0])
        if isinstance(each, ast.JoinedStr) and isinstance(each.values[0], ast.Constant)
    )
    assert [key for key in catalogue() if key not in strings() and not key.startswith(prefixes or ("\0",))] == []


def test_every_value_that_a_template_names_is_given() -> None:
    """And nothing else, where the values are written out."""
    for at, call in calls():
        given = {keyword.arg for keyword in call.keywords}
        named = {key: set(fields(catalogue()[key])) for key in keys_of(call)}
        if None not in given:
            assert all(names <= given for names in named.values()), at
        if named:
            assert given - {None} <= set().union(*named.values()), at


def stand_in(spec: str) -> Any:
    if spec in JOINS:
        return ("a", message("diagnosis.point", name="b"), "c")
    return 1.5 if spec and spec != "capitalised" else "some words"


@pytest.mark.parametrize("key", sorted(catalogue()))
def test_every_template_can_be_rendered(key: str) -> None:
    values: dict[str, Any] = {}
    for _, name, spec, _ in string.Formatter().parse(catalogue()[key]):
        if name is not None:
            values[name] = stand_in(spec or "")
            values |= dict.fromkeys(fields(spec or ""), ".3f")
    assert render(message(key, **values))
    assert "None" not in render(message(key, **dict.fromkeys(values)))  # what is None is left out


def test_values_are_joined_and_formatted() -> None:
    assert str(message("join.and", first="a", last="b")) == "a and b"
    pair = message("diagnosis.candidate", names=("pump", "leakage"), probability=0.9995)
    assert str(pair) == "pump + leakage (> 99.9 %)"
    for count, text in ((0, ""), (1, "a"), (2, "a or b"), (3, "a, b or c")):
        added = message("diagnosis.second_fault", names=tuple("abc"[:count]))
        assert f"second fault ({text})" in str(added)


def test_numbers_of_things_are_counted_in_words() -> None:
    assert [count_words(n, "asset") for n in (0, 1, 2)] == ["0 assets", "1 asset", "2 assets"]
    assert count_words(1, "row", "de") == "1 Zeile" and count_words("1\N{THIN SPACE}000", "row", "de").endswith(
        "Zeilen"
    )
    assert str(message("defect.no_stamp", rows=1)) == "1 row without a time stamp dropped"
    plural = re.compile(r"(?<!of )\{\w+\} (rows|samples|steps|gaps|warnings|evaluations|assets|sources|workers)\b")
    assert [key for key, text in catalogue().items() if not key.startswith("count.") and plural.search(text)] == []


def test_a_message_survives_json() -> None:
    inner = message("diagnosis.deviations", value=3.5)
    given = message("diagnosis.coefficients", t=60.0, changes=(inner, text_message("as {it} is")), unit=None)
    again = Message.model_validate_json(given.model_dump_json())
    assert again == given and str(again) == "By 60.0 s 3.5 standard deviations; as {it} is."


def test_records_of_other_versions_are_read_by_their_text() -> None:
    old = {"kind": "rest", "from_s": 1.0, "to_s": 2.0, "count": 3, "message": "at rest"}
    assert DiagnosisWarning.model_validate(old).description == text_message("at rest")
    later = {**old, "description": {"key": "warning.of_a_later_version", "values": {"x": 1}}}
    assert DiagnosisWarning.model_validate(later).message == "at rest"
    assert Mimic(name="k_p", words="another stiffness", value=1.2, unit="ratio").words == "another stiffness"  # type: ignore[call-arg]
    assert read_messages({"many": [None], "texts": ["a", "b"]}, many="texts") == {"many": ("a", "b")}


@cache
def diagnosed(name: str = "suspect") -> Diagnosis:
    baseline = ss.Baseline.load(FOLDER / "rig.json")
    return ss.diagnose(baseline, ss.read(FOLDER / f"{name}.parquet", baseline.loop))


@pytest.mark.parametrize("name", ["healthy", "suspect"])
def test_a_diagnosis_survives_json(name: str) -> None:
    diagnosis = diagnosed(name)
    assert Diagnosis.model_validate_json(diagnosis.model_dump_json()) == diagnosis
    document = json.loads(diagnosis.model_dump_json())
    assert document["summary"] == str(diagnosis.headline)
    assert document["explanation"] == [str(reason) for reason in diagnosis.reasons]
    assert bool(document["intervals"]) == (name == "suspect")


def test_the_current_interval_is_the_last_one() -> None:
    diagnosis = diagnosed()
    (interval,) = diagnosis.intervals
    assert interval.end_s is None and not interval.from_start
    earlier = interval.model_copy(update={"detected_at_s": 1.0, "end_s": 2.0, "faults": ()})
    both = diagnosis.model_copy(update={"intervals": (earlier, interval)})
    assert both.detected_at_s == diagnosis.detected_at_s and both.faults == diagnosis.faults
    assert Diagnosis.model_validate_json(both.model_dump_json()) == both


def test_a_headline_with_dates() -> None:
    diagnosis = diagnosed()
    assert f"since {diagnosis.onset_s[1]:.1f} s" in diagnosis.summary  # type: ignore[index]
    assert "since 2024-01-01 00:00:30 UTC" in str(diagnosis.dated_headline(1704067200.0))
    older = diagnosis.intervals[0].model_copy(update={"from_start": True})
    older_still = diagnosis.model_copy(update={"intervals": (older,)})
    assert "since 2024-01-01 00:00:00 UTC or before" in str(older_still.dated_headline(1704067200.0))
    assert "since 2023-12-31 23:59:50 UTC" in str(older_still.dated_headline(1704067200.0, 1704067190.0))


def test_another_language_replaces_the_wording_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    diagnosis = diagnosed()
    words = {"summary", "explanation", "warnings", "checks"}
    english, numbers = diagnosis.model_dump_json(), diagnosis.model_dump(exclude=words)
    (tmp_path / "en.toml").write_bytes(messages.FOLDER.joinpath("en.toml").read_bytes())
    (tmp_path / "de.toml").write_text(
        '[join]\nor = "{first} oder {last}"\n[diagnosis]\n'
        'fault = "Fehler{point}: {changes:and} {since}.{mimic}"\nsince = "seit {t:.1f} s{growth}"\n'
        'size = "{parameter} beträgt das {ratio:{digits}}-fache ({low:{digits}} bis {high:{digits}})"\n'
        'second_fault = "Ein zweiter Fehler ({names:or}) erklärt die Aufnahme nicht besser."\n',
        encoding="utf-8",
    )
    monkeypatch.setattr(messages, "FOLDER", tmp_path)
    monkeypatch.setattr(messages, "LANGUAGE", "de")
    catalogue.cache_clear()
    try:
        assert diagnosis.summary.startswith("Fehler: leakage has risen by a fifth seit 30.0 s.")
        assert (
            diagnosis.explanation[0].startswith("C_ie beträgt das 1.19") and "-fache (1.19" in diagnosis.explanation[0]
        )
        assert "Ein zweiter Fehler (contamination, friction oder pump) erklärt" in " ".join(diagnosis.explanation)
        assert diagnosis.explanation[1].startswith("Alarm at ")  # English where the language has nothing
        assert str(diagnosis.checks[0]).startswith(
            "Kolbendichtung"
        )  # the plant's own words, which it translates itself
        assert diagnosis.model_dump(exclude=words) == numbers
        assert render(diagnosis.headline, "en") == json.loads(english)["summary"]
    finally:
        catalogue.cache_clear()
    monkeypatch.undo()
    assert diagnosis.model_dump_json() == english


def test_a_rough_number_has_two_digits_and_no_exponent() -> None:
    numbers = {0.0123: "0.012", 4.34: "4.3", 43.2: "43", 99.4: "99", 99.6: "100", 143.0: "140", 1234.0: "1200"}
    assert {x: format_rough(x) for x in numbers} == numbers
    assert "by 100 %" in str(
        messages.message("change.risen", name="x", amount=messages.message("fraction.percent", percent=101.0))
    )
