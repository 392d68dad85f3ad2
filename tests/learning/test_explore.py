"""Structures of a motor axis: recordings that were left out choose the terms, and the loop file gets them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import run

import servoscope as ss
from servoscope.cli.explore import plant_table, replace_plant
from servoscope.core.errors import NotEnoughError
from servoscope.learning.axis_fit import fit_axis
from servoscope.learning.axis_structures import explore_structures
from servoscope.simulation import simulate

CONTROLLER = {"kind": "pi", "k_p": 400.0, "k_i": 0.0}


def recordings(plant: dict[str, Any], count: int = 3) -> tuple[ss.Loop, list[ss.Recording]]:
    settings = {"sample_rate": 100.0, "plant": {"kind": "axis", **plant}, "controller": CONTROLLER}
    loop, t = ss.Loop.from_dict(settings), np.arange(1500) / 100.0
    motions = [0.9 * np.sin((2.0 + k) * t) + 0.5 * np.sin((5.0 - 0.7 * k) * t) for k in range(count)]
    return loop, [simulate(loop, r, noise_u_std=0.2, noise_y_std=1e-5, seed=k)[0] for k, r in enumerate(motions)]


@pytest.mark.parametrize(
    ("terms", "coefficients"),
    [
        (("viscous", "coulomb", "gravity"), {"viscous_friction": 3.0, "coulomb_friction": 1.0, "gravity": 20.0}),
        (
            ("viscous_by_direction", "coulomb"),
            {"viscous_friction_forward": 2.0, "viscous_friction_backward": 4.0, "coulomb_friction": 1.0},
        ),
    ],
)
def test_the_terms_of_the_simulation_are_found(terms: tuple[str, ...], coefficients: dict[str, float]) -> None:
    loop, made = recordings({"terms": list(terms), "coefficients": {"inertia": 2.0, **coefficients}})
    found = explore_structures(loop, made)
    assert found[0].plant.terms == terms
    assert found[0].inertia == pytest.approx(2.0, rel=0.03)
    for name, value in coefficients.items():
        assert found[0].ratios[name] == pytest.approx(value / 2.0, rel=0.15)
    assert found[-1].excess > 100.0  # what leaves friction out predicts far worse


def test_one_recording_orders_nothing() -> None:
    plant = {"terms": ["viscous"], "coefficients": {"inertia": 2.0, "viscous_friction": 3.0}}
    loop, made = recordings(plant, 1)
    with pytest.raises(NotEnoughError, match="two or more"):
        explore_structures(loop, made)


def test_a_recording_at_rest_is_named() -> None:
    plant = {"terms": ["viscous"], "coefficients": {"inertia": 2.0, "viscous_friction": 3.0}}
    loop, made = recordings(plant, 2)
    still = simulate(loop, np.zeros(1500), noise_u_std=0.2, noise_y_std=1e-5, seed=9)[0]
    with pytest.raises(NotEnoughError, match="standing: it moves in 0 samples only"):
        explore_structures(loop, [*made, replace(still, name="standing")])
    with pytest.raises(NotEnoughError, match="standing: it moves in 0 samples only"):
        fit_axis(loop, [*made, replace(still, name="standing")])


def test_only_the_section_of_the_plant_is_replaced() -> None:
    text = (
        'name = "x"\n\n[plant]\nkind = "polynomial"\n\n[plant.coefficients]\ninertia = 1.0\n\n[monitor]\ncutoff = 5.0\n'
    )
    assert replace_plant(text, "[plant]\nnew\n") == 'name = "x"\n\n[plant]\nnew\n\n[monitor]\ncutoff = 5.0\n'
    assert replace_plant('name = "x"\n', "[plant]\nnew\n") == 'name = "x"\n[plant]\nnew\n'


@pytest.mark.slow
def test_emps_has_friction_by_direction(shared_data: Path, project: Path, tmp_path: Path) -> None:
    files = [shared_data / "real" / "emps" / f"{name}.mat" for name in ("DATA_EMPS", "DATA_EMPS_PULSES")]
    written = tmp_path / "axis.toml"
    said = run("explore", project / "examples" / "emps.toml", *files, "-o", written, "--json")
    assert json.loads(said.out)["structures"][0]["terms"] == ["viscous_by_direction", "coulomb"]
    loop = ss.Loop.load(written)
    assert loop.plant.kind == "axis" and loop.plant.input_gain == 35.15
    assert loop.columns.input == "vir"


@pytest.mark.slow
def test_a_free_swing_tells_gravity_over_inertia(shared_data: Path) -> None:
    """The motor is off from 2 s on; 71.7 1/s^2 with the rotor of the authors (Rhoban, BAM)."""
    columns = {"time": "timestamp", "reference": "goal_position", "input": "load % 65536", "output": "position"}
    plant = {"kind": "axis", "terms": ["viscous", "coulomb", "gravity"]}
    loop = ss.Loop.from_dict({"sample_rate": 200.0, "columns": columns | {"resample": True}, "plant": plant})
    files = sorted((shared_data / "real" / "xl330").glob("lift_and_drop*.parquet"))
    found = explore_structures(loop, [ss.read(path, loop).part(2.05, 99.0) for path in files])
    swinging = next(one for one in found if one.plant.terms == ("viscous", "coulomb", "gravity"))
    assert swinging.inertia is None
    assert swinging.ratios["gravity"] == pytest.approx(71.7, rel=0.05)
    assert plant_table(swinging).startswith(
        '[plant]\nkind = "axis"\nterms = ["viscous", "coulomb", "gravity", "offset"]'
    )
