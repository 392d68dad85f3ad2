"""The plant of a log: rows that were left out choose between polynomials and axes, and the terms of an axis."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import servoscope as ss
from servoscope.core.errors import NotEnoughError
from servoscope.learning.axis_fit import fit_axis
from servoscope.learning.plant_choice import PlantCandidate, choose_plant
from servoscope.learning.proposal import init
from servoscope.simulation import simulate

CONTROLLER = {"kind": "pi", "k_p": 400.0, "k_i": 0.0}
CUTOFF, REST_SPEED = 5.0, 0.01
FRICTION = {"viscous_friction": 3.0, "coulomb_friction": 1.0}
BY_DIRECTION = {"viscous_friction_forward": 2.0, "viscous_friction_backward": 4.0, "coulomb_friction": 1.0}


def recordings(plant: dict[str, Any], count: int = 3) -> tuple[ss.Loop, list[ss.Recording]]:
    settings = {"sample_rate": 100.0, "plant": {"kind": "axis", **plant}, "controller": CONTROLLER}
    loop, t = ss.Loop.from_dict(settings), np.arange(1500) / 100.0
    motions = [0.9 * np.sin((2.0 + k) * t) + 0.5 * np.sin((5.0 - 0.7 * k) * t) for k in range(count)]
    return loop, [simulate(loop, r, noise_u_std=0.2, noise_y_std=1e-5, seed=k)[0] for k, r in enumerate(motions)]


def chosen(plant: dict[str, Any], count: int = 3) -> PlantCandidate:
    return choose_plant(recordings(plant, count)[1], CUTOFF, False, REST_SPEED)[0]


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize(
    ("terms", "coefficients"),
    [
        (["viscous", "coulomb"], FRICTION),
        (["viscous_by_direction", "coulomb"], BY_DIRECTION),
        (["viscous", "coulomb", "gravity"], {**FRICTION, "gravity": 20.0}),
        (["viscous", "coulomb", "stiffness"], {**FRICTION, "stiffness": 60.0}),
    ],
)
def test_the_terms_of_the_simulation_are_chosen(terms: list[str], coefficients: dict[str, float], count: int) -> None:
    supported = chosen({"terms": terms, "coefficients": {"inertia": 2.0, **coefficients}}, count)
    assert supported.settings["kind"] == "axis"
    assert set(supported.settings["terms"]) == {*terms, "offset"}  # type: ignore[call-overload]
    assert 0.95 < supported.explained < 1.0


def test_u_that_counts_the_other_way_is_the_same_machine(tmp_path: Path) -> None:
    _, (rec, *_) = recordings({"terms": ["viscous", "coulomb"], "coefficients": {"inertia": 2.0, **FRICTION}})
    (supported, *_), (turned, *_) = (
        choose_plant([replace(rec, u=sign * rec.u)], CUTOFF, False, REST_SPEED) for sign in (1.0, -1.0)
    )
    assert turned.settings == supported.settings and (supported.reversed, turned.reversed) == (False, True)
    path = tmp_path / "turned.csv"
    np.savetxt(path, np.column_stack([rec.t, rec.r, -rec.u, rec.y]), delimiter=",", header="t,r,u,y", comments="")
    proposal = init(path)
    assert proposal.loop.columns.input == "-1 * u" and proposal.loop.plant.kind == "axis"
    assert "u counts against y" in proposal.to_toml()


def test_where_a_weight_hangs_is_found() -> None:
    coefficients = {"inertia": 2.0, **FRICTION, "gravity": 20.0}
    terms = ["viscous", "coulomb", "gravity"]
    supported = chosen({"terms": terms, "hanging_at": 0.7, "coefficients": coefficients})
    assert supported.settings["hanging_at"] == pytest.approx(0.7, abs=0.05)
    assert "hanging_at" not in chosen({"terms": terms, "coefficients": coefficients}).settings


def test_a_spring_without_friction_is_a_polynomial() -> None:
    coefficients = {"inertia": 2.0, "viscous_friction": 3.0, "stiffness": 60.0}
    supported = chosen({"terms": ["viscous", "stiffness"], "coefficients": coefficients})
    assert supported.settings["kind"] == "polynomial"
    assert (supported.settings["order"], supported.settings["stiffness"]) == (2, True)


def test_a_recording_at_rest_is_refused() -> None:
    plant = {"terms": ["viscous"], "coefficients": {"inertia": 2.0, "viscous_friction": 3.0}}
    loop, made = recordings(plant, 2)
    still = simulate(loop, np.zeros(1500), noise_u_std=0.2, noise_y_std=1e-5, seed=9)[0]
    with pytest.raises(NotEnoughError, match="standing: it moves in 0 samples only"):
        fit_axis(loop, [*made, replace(still, name="standing")])
    with pytest.raises(NotEnoughError, match="moves too little to compare plants"):
        choose_plant([still.part(0.0, 0.5)], CUTOFF, False, REST_SPEED)


def test_the_healthy_axis_does_not_depend_on_the_unit_of_y() -> None:
    loop, made = recordings({"terms": ["viscous", "coulomb"], "coefficients": {"inertia": 2.0, **FRICTION}}, 2)
    metres, microns = (fit_axis(loop, [replace(one, y=unit * one.y) for one in made])[0] for unit in (1.0, 1e6))
    assert metres is not None and microns is not None
    assert microns.coefficients["coulomb_friction"] == pytest.approx(metres.coefficients["coulomb_friction"], rel=1e-6)
    assert microns.noise.y_std == pytest.approx(1e6 * metres.noise.y_std, rel=1e-6)


@pytest.mark.slow
def test_emps_has_friction_by_direction(shared_data: Path) -> None:
    files = [shared_data / "real" / "emps" / f"{name}.mat" for name in ("DATA_EMPS", "DATA_EMPS_PULSES")]
    for logs in (files[:1], files):
        proposal = init(logs)
        assert proposal.candidates[0].settings == {
            "kind": "axis",
            "terms": ["viscous_by_direction", "coulomb", "offset"],
        }


@pytest.mark.slow
def test_a_hobby_servo_has_friction_by_load(shared_data: Path) -> None:
    proposal = init(sorted((shared_data / "real" / "xl330").glob("*.parquet")))
    assert proposal.candidates[0].settings["terms"] == ["viscous", "gravity", "load_friction", "offset"]
