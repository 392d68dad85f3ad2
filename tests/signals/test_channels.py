"""Column mappings and linear combinations of channels, as text."""

from __future__ import annotations

import pytest

from servoscope.core.errors import LoopError, RecordingError
from servoscope.models.loop import Columns
from servoscope.signals.readers.columns import LinearCombination, parse_columns, parse_combination

KNOWN = ["set_point", "position_error", "vir", "counts", "x", "motor speed", "log.y", "m[0]", "a-b"]


@pytest.mark.parametrize(
    ("text", "factors", "constant"),
    [
        ("vir", {"vir": 1.0}, 0.0),
        (" vir ", {"vir": 1.0}, 0.0),
        ("set_point - position_error", {"set_point": 1.0, "position_error": -1.0}, 0.0),
        ("35.15 * vir", {"vir": 35.15}, 0.0),
        ("vir*35.15", {"vir": 35.15}, 0.0),
        ("0.025*counts + 3", {"counts": 0.025}, 3.0),
        ("-x/2", {"x": -0.5}, 0.0),
        ("2*(x - 1) + +x", {"x": 3.0}, -2.0),
        ("1e-3*x", {"x": 1e-3}, 0.0),
        ("2*3*x/4", {"x": 1.5}, 0.0),
        ("motor speed", {"motor speed": 1.0}, 0.0),
        ("2 * `motor speed` - `x`", {"motor speed": 2.0, "x": -1.0}, 0.0),
        ("`motor speed`", {"motor speed": 1.0}, 0.0),
        ("2*log.y + m[0]", {"log.y": 2.0, "m[0]": 1.0}, 0.0),
        ("a-b", {"a-b": 1.0}, 0.0),
        ("-`a-b`", {"a-b": -1.0}, 0.0),
    ],
)
def test_linear_combinations_are_understood(text: str, factors: dict[str, float], constant: float) -> None:
    assert parse_combination(text, KNOWN, "x.csv: [columns] input") == LinearCombination(factors, constant)


@pytest.mark.parametrize(
    "text",
    [
        "x*vir",
        "x/vir",
        "1/x",
        "x**2",
        "abs(x)",
        "x +",
        "x; vir",
        "[x]",
        "'x'",
        "True*x",
        "x/0",
        "x > 1",
        "__import__('os').system('true')",
        "(" * 300 + "x" + ")" * 300,
    ],
)
def test_what_is_not_linear_is_refused(text: str) -> None:
    with pytest.raises(LoopError, match="only sums of channels and numbers") as caught:
        parse_combination(text, KNOWN, "x.csv: [columns] input")
    assert str(caught.value).startswith("x.csv: [columns] input = ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["3", "2*4 - 1", "x - x"])
def test_a_combination_needs_a_channel(text: str) -> None:
    with pytest.raises(LoopError, match="names no channel"):
        parse_combination(text, KNOWN, "x.csv: [columns] input")


@pytest.mark.parametrize("text", ["Vir", "2*Vir", "`Vir`"])
def test_an_unknown_channel_names_the_nearest(text: str) -> None:
    with pytest.raises(RecordingError, match="no column 'Vir', did you mean vir"):
        parse_combination(text, KNOWN, "x.csv: [columns] input")


def test_an_unknown_channel_with_a_blank_is_told_as_such() -> None:
    with pytest.raises(RecordingError, match="no column 'moter speed', did you mean motor speed"):
        parse_combination("moter speed", KNOWN, "x.csv: [columns] input")


def test_a_mapping_on_one_line() -> None:
    assert parse_columns("r=qg,u=vir,y=qm,t=t") == Columns(reference="qg", input="vir", output="qm")
    found = parse_columns("t=time[ms], y = set_point - position_error, segment=load+run")
    assert (found.time, found.time_unit) == ("time", "ms")
    assert found.output == "set_point - position_error"
    assert found.segment == ("load", "run")
    assert parse_columns("t=").time is None
    assert parse_columns("u=`a,b`, time=`time stamp`[us]") == Columns(input="`a,b`", time="time stamp", time_unit="us")


def test_a_mapping_changes_what_it_names_only() -> None:
    base = Columns(time="clock", time_unit="ms", reference="a")
    assert parse_columns("u=b", base) == Columns(time="clock", time_unit="ms", reference="a", input="b")


@pytest.mark.parametrize(
    ("text", "said"), [("q=x", "'q=x' is not one of"), ("vir", "'vir' is not"), ("u=", "'u=' is not")]
)
def test_a_mapping_that_cannot_be_read_is_refused(text: str, said: str) -> None:
    with pytest.raises(LoopError, match=said):
        parse_columns(text)


def test_an_unknown_unit_is_refused() -> None:
    with pytest.raises(LoopError, match=r"columns: time_unit: 'h' is not one of"):
        parse_columns("t=time[h]")
