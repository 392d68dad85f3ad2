"""Loop files: what is accepted, what is refused, and in which words."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from servoscope.core.errors import LoopError, ObsoleteSettingWarning, ServoscopeError
from servoscope.models.loop import DEFAULT_FREQUENCIES, Columns, Loop, MonitorSettings

RIG = """
name = "reference rig"
sample_rate = 100.0
[plant]
kind = "eha"
m_p = 4.0
b_p = 200.0
k_p = 26687.41
A_p = 4e-4
V_o = 1e-4
beta = 1e9
C_ie = 6e-12
p_s = 14e6
rho = 850.0
C_d = 0.6
W = 0.02
K_m = 1e-3
[controller]
kind = "pi"
k_p = 20.0
k_i = 5.0
[monitor]
cutoff = 10.0
"""


def refusal(mapping: Any) -> str:
    with pytest.raises(LoopError) as caught:
        Loop.from_dict(mapping, source="loop.toml")
    text = str(caught.value)
    assert "\n" not in text
    assert text.startswith("loop.toml: ")
    assert "pydantic" not in text
    return text


def refusal_of_file(path: Path) -> str:
    with pytest.raises(LoopError) as caught:
        Loop.load(path)
    text = str(caught.value)
    assert "\n" not in text
    assert path.name in text
    return text


def test_a_file_is_read_with_its_defaults(tmp_path: Path) -> None:
    path = tmp_path / "loop.toml"
    path.write_text(RIG)
    loop = Loop.load(path)
    assert loop.sample_rate == 100.0
    assert loop.plant.kind == "eha"
    assert loop.columns == Columns()
    assert loop.monitor.frequencies == DEFAULT_FREQUENCIES
    assert loop.monitor.memory == 5.0
    assert loop.monitor.estimator == "akf"
    assert loop.controller is not None
    assert loop.controller.k_p == 20.0


def test_a_byte_order_mark_does_not_matter(tmp_path: Path) -> None:
    path = tmp_path / "loop.toml"
    path.write_bytes(b"\xef\xbb\xbf" + RIG.encode())
    assert Loop.load(path).name == "reference rig"


def test_the_controller_is_optional(rig: dict[str, Any]) -> None:
    del rig["controller"]
    assert Loop.from_dict(rig).controller is None


def test_every_key_of_the_design_is_understood(rig: dict[str, Any]) -> None:
    rig |= {
        "hold": "foh",
        "delay": 0.01,
        "input_logged": "before_limiter",
        "input_limits": [-1, 1],
        "input_deadzone": [-0.1, 0.1],
    }
    rig["columns"] = {
        "time": "ms",
        "reference": "a",
        "input": "b",
        "output": "a - e",
        "time_unit": "ms",
        "segment": ["x"],
    }
    rig["monitor"] = {
        "structure": "tustin",
        "cutoff": 10.0,
        "estimator": "rls",
        "two_stage": "none",
        "memory": 3,
        "model_error": 0.02,
        "update_when": "moving",
        "rest_speed": 0.001,
        "evaluation_rate": 5.0,
        "frequencies": [1.0, 2.5],
        "false_alarms_per_year": 0.1,
    }
    loop = Loop.from_dict(rig)
    assert loop.input_limits == (-1.0, 1.0)
    assert loop.columns.segment == ("x",)
    assert loop.monitor.frequencies == (1.0, 2.5)


@pytest.mark.parametrize("rate", [100.0, 25.0, 1.5])
def test_a_loop_survives_json(rig: dict[str, Any], rate: float) -> None:
    loop = Loop.from_dict(rig | {"sample_rate": rate})
    again = Loop.from_dict(json.loads(json.dumps(loop.to_dict())))
    assert again == loop
    assert again.hash() == loop.hash()


def test_a_polynomial_loop_survives_json(rig: dict[str, Any]) -> None:
    rig["plant"] = {"kind": "polynomial", "order": 2, "friction": "coulomb", "offset": True}
    loop = Loop.from_dict(rig | {"sample_rate": 25.0})
    assert Loop.from_dict(json.loads(json.dumps(loop.to_dict()))) == loop


def test_no_time_column_survives_json(rig: dict[str, Any]) -> None:
    loop = Loop.from_dict(rig)
    loop = loop.model_copy(update={"columns": Columns(time=None)})
    assert Loop.from_dict(json.loads(json.dumps(loop.to_dict()))).columns.time is None


def test_the_hash_knows_every_setting(rig: dict[str, Any]) -> None:
    first = Loop.from_dict(rig).hash()
    assert Loop.from_dict(rig).hash() == first
    rig["plant"]["C_ie"] *= 1.001
    assert Loop.from_dict(rig).hash() != first


def test_a_loop_is_frozen(rig: dict[str, Any]) -> None:
    loop = Loop.from_dict(rig)
    with pytest.raises(ValueError, match="frozen"):
        loop.sample_rate = 1.0  # type: ignore[misc]


def test_default_frequencies_give_way_to_a_slow_sample_rate(rig: dict[str, Any]) -> None:
    assert Loop.from_dict(rig | {"sample_rate": 25.0}).monitor.frequencies == (1.0, 10.0)
    assert Loop.from_dict(rig | {"sample_rate": 2.0}).monitor.frequencies == (0.2,)
    loop = Loop(sample_rate=25.0, plant=Loop.from_dict(rig).plant, monitor=MonitorSettings(memory=2.0))
    assert loop.monitor == MonitorSettings(memory=2.0, frequencies=(1.0, 10.0))


def test_the_default_sign_filter_gives_way_to_a_slow_sample_rate(rig: dict[str, Any]) -> None:
    plant = {"kind": "polynomial", "order": 2, "friction": "coulomb"}
    assert Loop.from_dict({"sample_rate": 25.0, "plant": plant}).plant.sign_cutoff == 6.25  # type: ignore[attr-defined]
    text = refusal({"sample_rate": 25.0, "plant": plant | {"sign_cutoff": 20.0}})
    assert text.startswith("loop.toml: [plant] sign_cutoff: 20 Hz is not below the Nyquist frequency of 12.5 Hz")


def test_an_unknown_key_names_the_nearest(rig: dict[str, Any]) -> None:
    rig["monitor"] = {"cutof": 10.0}
    assert refusal(rig) == "loop.toml: [monitor] cutof: unknown key, did you mean 'cutoff'?"


def test_an_unknown_key_of_the_plant_names_the_nearest(rig: dict[str, Any]) -> None:
    rig["plant"]["c_ie"] = rig["plant"].pop("C_ie")
    assert refusal(rig) == "loop.toml: [plant] c_ie: unknown key, did you mean 'C_ie'?"


def test_an_unknown_section_names_the_nearest(rig: dict[str, Any]) -> None:
    rig["moniter"] = {}
    assert refusal(rig) == "loop.toml: moniter: unknown key, did you mean 'monitor'?"


def test_a_key_outside_its_section_is_sent_home(rig: dict[str, Any]) -> None:
    rig["cutoff"] = 10.0
    assert refusal(rig) == "loop.toml: cutoff: unknown key here, it belongs in [monitor]"


@pytest.mark.parametrize(
    ("section", "key", "value", "said"),
    [
        ("", "sample_rate", -100.0, "sample_rate: -100.0 must be greater than 0"),
        ("", "sample_rate", "100", "sample_rate: '100' is not a number"),
        ("", "sample_rate", True, "sample_rate: true is not a number"),
        ("", "sample_rate", float("nan"), "sample_rate: nan is not a finite number"),
        ("", "hold", "zho", "hold: 'zho' is not one of 'zoh' or 'foh'"),
        ("", "delay", -0.1, "delay: -0.1 must be at least 0"),
        ("", "delay", 10.0, "delay: 10 s is more than 100 samples, give it in seconds"),
        ("", "name", 3, "name: 3 is not text, put it in quotes"),
        ("", "input_limits", [1.0, -1.0], "input_limits: [1, -1] must be [lo, hi] with lo below hi"),
        ("", "input_limits", [1.0], "input_limits: has too few entries"),
        ("", "input_limits", [0, 1, 2], "input_limits: has 3 entries, needs at most 2"),
        ("", "input_limits", ["a", 1], "input_limits, entry 1: 'a' is not a number"),
        ("", "input_logged", "before_limiter", "input_limits: missing"),
        ("", "monitor", 5, "monitor: 5 is not a table of settings"),
        ("", "plant", "eha", "plant: 'eha' is not a table of settings"),
        ("plant", "kind", "ehaa", "[plant] kind = 'ehaa': unknown, choose from"),
        ("plant", "beta", -1e9, "[plant] beta: -1000000000.0 must be greater than 1e-30"),
        ("plant", "beta", "1e9", "[plant] beta: '1e9' is not a number"),
        ("controller", "kind", "pid", "[controller] kind: 'pid' is not one of 'pi'"),
        ("controller", "k_p", 0.0, "[controller] k_p: 0.0 must be greater than 0"),
        ("columns", "time_unit", "h", "[columns] time_unit: 'h' is not one of"),
        ("columns", "segment", "run", "[columns] segment: 'run' is not a list, write [ ... ]"),
        ("columns", "output", "", "[columns] output: must not be empty"),
        ("monitor", "cutoff", 60.0, "[monitor] cutoff: 60 Hz is not below the Nyquist frequency of 50 Hz"),
        ("monitor", "cutoff", 1e-300, "[monitor] cutoff: 1e-300 Hz is below a millionth of sample_rate = 100 Hz"),
        ("monitor", "cutoff", 0.0, "[monitor] cutoff: 0.0 must be greater than 0"),
        ("monitor", "frequencies", [1.0, 50.0], "[monitor] frequencies: 50 Hz is not below the Nyquist"),
        ("monitor", "frequencies", [], "[monitor] frequencies: has 0 entries, needs at least 1"),
        ("monitor", "frequencies", [2.0, 2.0], "[monitor] frequencies: a frequency stands twice"),
        ("monitor", "frequencies", [1.0, "2"], "[monitor] frequencies, entry 2: '2' is not a number"),
        ("monitor", "memory", 0.0, "[monitor] memory: 0.0 must be greater than 0"),
        ("monitor", "memory", 0.001, "[monitor] memory: 0.001 s is shorter than two samples"),
        ("monitor", "model_error", 2.0, "[monitor] model_error: 2.0 must be less than 1"),
        ("monitor", "evaluation_rate", 1000.0, "[monitor] evaluation_rate: 1000 Hz is above sample_rate"),
        ("monitor", "update_when", "never", "[monitor] update_when: 'never' is not one of"),
        ("monitor", "structure", 3, "[monitor] structure: 3 is not one of 'svf', 'tustin'"),
    ],
)
def test_a_wrong_value_is_refused(rig: dict[str, Any], section: str, key: str, value: Any, said: str) -> None:
    (rig.setdefault(section, {}) if section else rig)[key] = value
    assert refusal(rig).startswith(f"loop.toml: {said}")


def test_a_missing_sample_rate_is_named(rig: dict[str, Any]) -> None:
    del rig["sample_rate"]
    assert refusal(rig) == "loop.toml: sample_rate: missing, add it"


def test_a_missing_plant_is_named(rig: dict[str, Any]) -> None:
    del rig["plant"]
    assert refusal(rig) == "loop.toml: [plant]: missing, add the section"


def test_a_missing_kind_is_named(rig: dict[str, Any]) -> None:
    del rig["plant"]["kind"]
    assert refusal(rig).startswith("loop.toml: [plant] kind: missing, choose from")


def test_a_missing_parameter_of_the_plant_is_named(rig: dict[str, Any]) -> None:
    del rig["plant"]["beta"]
    assert refusal(rig) == "loop.toml: [plant] beta: missing, add it"


def test_a_missing_gain_is_named(rig: dict[str, Any]) -> None:
    del rig["controller"]["k_i"]
    assert refusal(rig) == "loop.toml: [controller] k_i: missing, add it"


def test_wrong_coefficients_of_a_polynomial_are_told() -> None:
    plant = {"kind": "polynomial", "order": 2, "coefficients": {"mass": 1.0}}
    told = refusal({"sample_rate": 100.0, "plant": plant})
    assert told.startswith(
        "loop.toml: [plant] coefficients: give each of viscous_friction, inertia; check inertia, mass"
    )


def test_what_is_no_table_is_refused() -> None:
    assert refusal([1, 2]) == "loop.toml: must be a table of settings, found list"


def test_a_missing_file_is_told(tmp_path: Path) -> None:
    assert "no such file" in refusal_of_file(tmp_path / "lop.toml")


def test_a_directory_is_told(tmp_path: Path) -> None:
    assert "is a directory" in refusal_of_file(tmp_path)


def test_a_syntax_error_is_told_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "loop.toml"
    path.write_text('name = "x"\nsample_rate = \n')
    assert "line 2" in refusal_of_file(path)


def test_a_binary_file_is_told(tmp_path: Path) -> None:
    path = tmp_path / "loop.toml"
    path.write_bytes(b"\x89PNG\r\n\x1a\n\x00\xff")
    assert "is not a text file" in refusal_of_file(path)


def test_an_empty_file_is_told(tmp_path: Path) -> None:
    path = tmp_path / "loop.toml"
    path.write_text("")
    assert "missing" in refusal_of_file(path)


def test_one_except_clause_catches_all() -> None:
    assert issubclass(LoopError, ServoscopeError)


def test_a_setting_of_an_earlier_version_is_read_with_a_warning(tmp_path: Path) -> None:
    path = tmp_path / "loop.toml"
    path.write_text(f'{RIG}sequential_step = "update"\n', encoding="utf-8")
    with pytest.warns(ObsoleteSettingWarning, match=r"loop\.toml: \[monitor\] sequential_step.*evaluation_rate"):
        loop = Loop.load(path)
    assert Loop.from_dict(loop.to_dict()) == loop  # what a baseline keeps brings no warning
