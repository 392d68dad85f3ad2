"""Columns by their names, as makers' tools write them: quantity first, then what is asked for and what is measured."""

from __future__ import annotations

from pathlib import Path

import pytest
from commands import run
from hypothesis import given
from hypothesis import strategies as st
from named_logs import Outcome, find_outcome, makers, named_logs

from servoscope.core.errors import LoopError
from servoscope.models.columns import Columns
from servoscope.models.loop import Loop
from servoscope.signals.readers.axes import signal_names
from servoscope.signals.readers.column_words import split_words
from servoscope.signals.readers.guess_columns import guess_columns, guess_mapping
from servoscope.signals.readers.recording_file import ChannelInfo
from servoscope.signals.readers.units import split_unit


def test_logs_with_the_names_of_makers_are_right_and_never_wrong_in_silence(tmp_path: Path) -> None:
    logs = list(named_logs(each=1))
    found = {log.file: find_outcome(log, tmp_path) for log in logs}
    assert len(logs) >= 30 and all(maker["page"].startswith("https://") for maker in makers())
    assert sum(outcome is Outcome.RIGHT for outcome, _ in found.values()) >= 0.9 * len(logs), found
    assert not {file: said for file, (outcome, said) in found.items() if outcome in (Outcome.WRONG, Outcome.UNIT)}


@pytest.mark.parametrize(
    ("names", "proposed"),
    [
        ("time|axis0.controller.pos_setpoint|axis0.encoder.vel_estimate|axis0.encoder.pos_estimate|"
         "axis0.motor.current_control.Iq_measured|axis0.motor.current_control.Iq_setpoint", "0153"),
        ("time_s|SP|PV|PID_OUT", "0132"),
        ("Zeit|Stromistwert|Stromsollwert|Lageistwert|Lagesollwert", "0423"),
        ("t|fSetPosition|fActPosition|fActTorque|fSetVelocity", "0132"),
        ("t|Current Position|Target Position|Control Voltage", "0231"),
        ("t|actual_q_1|target_moment_1|actual_current_1|target_q_1", "0431"),
        ("t|Setpoint|Input|Output", "0123"),
        ("t|PID.Setpoint|PID.Input|PID.Output", "0132"),
        ("t|w|x|y", "0132"),
        ("t|out.r|out.u|out.y|out.v_ref", "0123"),
        ("TimeUS|RATE.AOut|RATE.ROut|RATE.R|RATE.RDes", "0423"),
        ("t|VL.CMD|PL.CMD|IL.CMD|PL.FB|IL.FB", "0234"),
        ("t|Position|ActualPosition|d_axis_current|q_axis_current", "0142"),
        ("t|measured current|setpoint|speed", "0213"),
        ("t|q1|q2|tau2|q_des2", "0432"),
        ("t|r|tau|theta_d|theta", "0124"),
        ("t|target_theta|theta|control_output|feedforward|plant_input|saturation", "0152"),
        ("t|force setpoint|valve|measured force", "0123"),
    ],
)  # fmt: skip
def test_quantities_count_before_words_of_the_role(names: str, proposed: str) -> None:
    columns = names.split("|")
    assert guess_columns(columns) == {
        letter: columns[int(place)] for letter, place in zip("truy", proposed, strict=True)
    }


@given(st.permutations(["time", "pos_cmd", "velocity", "actual current", "bus voltage", "position", "pos error"]))
def test_the_order_of_columns_changes_nothing(names: list[str]) -> None:
    assert guess_columns(names) == {"t": "time", "r": "pos_cmd", "u": "actual current", "y": "position"}


@given(
    st.lists(st.sampled_from(["tau", "current", "Motorstrom", "torque_actual", "Ist-Moment", "u_volt"]), unique=True)
)
def test_an_effort_is_no_output_while_another_column_is_left(efforts: list[str]) -> None:
    assert guess_columns([*efforts, "angle", "angle_ref"]).get("y") == "angle"


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("vel_mm_s", ("vel", "mm/s")), ("x_m_s", ("x", "m/s")), ("n_U_min", ("n", "U/min")), ("t_s", ("t", "s")),
        ("speed / pulse/s", ("speed", "pulse/s")), ("joint_A", ("joint_A", "")), ("I / A", ("I", "A")),
        ("rpm", ("rpm", "rpm")), ("phi [Grad]", ("phi", "Grad")),
    ],
)  # fmt: skip
def test_units_without_brackets(name: str, parts: tuple[str, str]) -> None:
    assert split_unit(name) == parts


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("Momentensollwert", ("moment", "sollwert")), ("Drehmoment-Sollwert", ("drehmoment", "sollwert")),
        ("lrSetPos", ("set", "pos")), ("yref", ("y", "ref")), ("offset", ("offset",)),
    ],
)  # fmt: skip
def test_words_of_a_name(name: str, words: tuple[str, ...]) -> None:
    assert split_words(name) == words


def test_clocks_have_the_unit_that_their_name_ends_or_begins_with() -> None:
    for name, unit in (("TimeUS", "us"), ("ms_today", "ms"), ("Time", "s"), ("time [ms]", "ms"), ("Status time", "s")):
        assert guess_mapping([name, "u", "y"])["time_unit"] == unit


@pytest.mark.parametrize(("low", "high", "kept"), [(526.0, 680.0, True), (600.0, 610.0, True), (-1.0, 1.0, True)])
def test_a_position_far_from_zero_is_no_supply(low: float, high: float, kept: bool) -> None:
    names = {
        "t": (0.0, 9.0),
        "ActPosition_mm": (low, high),
        "torque": (-1.0, 1.0),
        "24V": (23.8, 24.2),
        "aux": (40.0, 78.0),
    }
    channels = [ChannelInfo(name, "double", *limits) for name, limits in names.items()]
    found = signal_names(channels)
    assert ("ActPosition_mm" in found) is kept and "aux" in found and "24V" not in found


@pytest.mark.parametrize("output", ["current", "0.001 * current", "`current`"])
def test_one_column_is_not_both_u_and_y(tmp_path: Path, output: str) -> None:
    with pytest.raises(LoopError, match="input and output are one column, 'current'"):
        Loop.from_dict({"sample_rate": 100.0, "columns": {"input": "current", "output": output}})
    assert Columns(input="current", output="position").outputs == ("position",)
    path = tmp_path / "log.csv"
    path.write_text("t,current,position\n" + "".join(f"{k},{k % 3},{k % 5}\n" for k in range(50)))
    told = run("init", path, "--columns", f"u=current,y={output}")
    assert told.code == 2 and "input and output are one column" in told.err and "Traceback" not in told.err
