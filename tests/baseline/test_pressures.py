"""Logged pressures of a cylinder: equations that hold, faults by name and size, from a log's columns to a verdict."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import servoscope as ss
from servoscope.baseline.pressure_model import FORCE, NAMES, PressureModel
from servoscope.signals import Recording
from servoscope.signals.readers.guess_columns import guess_pressures
from servoscope.simulation import CylinderRig, FaultEvent, cylinder_motion, simulate_cylinder

PRESSURES = {"A": "p_A", "B": "p_B", "supply": "p_S"}


def day(seed: int, *faults: FaultEvent, duration_s: float = 30.0) -> Recording:
    rig = CylinderRig(temperature=38.0 + 3.0 * (seed % 6))
    log, _ = simulate_cylinder(cylinder_motion("production", duration_s, 250.0, seed), rig, faults=faults, seed=seed)
    return replace(log, name=f"day {seed}")


def loop(**pressures: str) -> ss.Loop:
    plant = {"kind": "cylinder", "terms": ["spring", "process", "overlap", "offset"], "contact": 0.06}
    monitor = {"cutoff": 10.0, "memory": 7.0, "frequencies": [0.5, 2.0]}
    return ss.Loop.from_dict({"sample_rate": 250.0, "plant": {**plant, "pressures": pressures}, "monitor": monitor})


@pytest.fixture(scope="module")
def learned() -> ss.Baseline:
    return ss.learn(loop(**PRESSURES), [day(seed) for seed in range(6)])


def model_of(baseline: ss.Baseline) -> PressureModel:
    assert baseline.pressures is not None
    return baseline.pressures


def test_coefficients_are_those_of_the_rig(learned: ss.Baseline) -> None:
    model, rig = model_of(learned), CylinderRig()
    theta = dict(zip(NAMES, model.theta, strict=True))
    assert model.layout.area == pytest.approx(rig.area_b / rig.area_a, rel=0.1)
    assert theta["supply"] * model.layout.supply == pytest.approx(rig.pump_pressure, rel=0.02)
    # u of a speed, at a drop of the mean supply pressure
    gain = rig.area_a / (rig.gain_extend * np.sqrt(model.layout.supply)) * rig.limit
    assert theta["forward"] == pytest.approx(gain, rel=0.1)
    assert theta["spring"] == pytest.approx(rig.spring / (rig.area_a * model.layout.supply), rel=0.1)


def test_healthy_days_are_healthy(learned: ss.Baseline) -> None:
    model = model_of(learned)
    assert all((model.ratios(model.layout.sums(day(seed))) < 1.0).all() for seed in range(20, 26))
    assert ss.diagnose(learned, day(26)).verdict == "healthy"


@pytest.mark.parametrize(
    ("parameters", "ratio", "name", "size"),
    [
        (("pump_pressure",), 0.96, "supply", (0.95, 0.97)),
        (("leakage",), 10.0, "leakage", (4.0, 20.0)),
        (("friction", "viscous"), 4.0, "friction", (1.5, 4.0)),
        (("gain_extend",), 0.92, "valve_forward", (0.9, 0.94)),
        (("overlap",), 2.0, "overlap", (1.8, 2.4)),
        (("process_force",), 2.0, "process_force", (1.5, 3.5)),
    ],
)
def test_faults_are_named_with_their_sizes(
    learned: ss.Baseline, parameters: tuple[str, ...], ratio: float, name: str, size: tuple[float, float]
) -> None:
    at_s = 0.0 if name in ("friction", "process_force") else 12.0  # forces differ from stroke to stroke
    faults = [FaultEvent(parameter, ratio, at_s) for parameter in parameters]
    diagnosis = ss.diagnose(learned, day(30, *faults))
    assert [fault.name for fault in diagnosis.faults] == [name]
    assert size[0] < diagnosis.faults[0].ratio < size[1]
    assert diagnosis.onset_s is not None
    assert diagnosis.onset_s[0] <= at_s <= diagnosis.onset_s[2]
    assert any("pressures" in str(reason) for reason in diagnosis.reasons)


def test_without_a_process_or_with_another_unit_nothing_else_changes(learned: ss.Baseline) -> None:
    model = model_of(learned)
    plain = model.layout.model_copy(update={"contact": None, "rms": ()})
    assert np.flatnonzero(np.isnan(plain.coefficients(_total(plain.sums(day(40)))))) == NAMES.index("process")
    bar = replace(day(40), channels={name: values / 1e5 for name, values in day(40).channels.items()})
    in_bar = model.layout.model_copy(update={"supply": model.layout.supply / 1e5})
    np.testing.assert_allclose(
        in_bar.coefficients(_total(in_bar.sums(bar))), model.layout.coefficients(_total(model.layout.sums(day(40))))
    )


def _total(sums: tuple[np.ndarray, ...]) -> tuple[np.ndarray, ...]:
    return tuple(S.sum(axis=0) for S in sums)


def test_few_recordings_or_none_of_the_pressures(learned: ss.Baseline) -> None:
    few = ss.learn(learned.loop, [day(seed) for seed in range(3)])
    assert few.pressures is None
    assert any("pressures are learned" in str(note) for note in few.notes)
    bare = replace(day(41), channels={})
    assert model_of(learned).evidence(bare) is None
    assert ss.diagnose(learned, bare).verdict != "fault"


def test_a_baseline_promises_what_pressures_show(learned: ss.Baseline, tmp_path: Path) -> None:
    changes = {change.name: change.change for change in learned.detectability.changes}
    assert changes["leakage"] is not None  # which no term of the loop file shows
    learned.save(tmp_path / "baseline.json")
    again = ss.Baseline.load(tmp_path / "baseline.json")
    assert again.pressures == learned.pressures
    assert len(FORCE) == 6


def test_pressures_are_guessed_and_read_from_a_log(tmp_path: Path) -> None:
    names = ["t", "soll", "pressure A (bar)", "pressure B (bar)", "supply pressure (MPa)", "temperature"]
    assert guess_pressures(names) == {
        "A": "100000 * `pressure A (bar)`",
        "B": "100000 * `pressure B (bar)`",
        "supply": "1000000 * `supply pressure (MPa)`",
    }
    assert guess_pressures(["pA", "p_B"]) is None
    log = day(50, duration_s=5.0)
    table = np.column_stack([log.t, log.r, log.u, log.y, *(1e-5 * log.channels[p] for p in PRESSURES.values())])
    np.savetxt(tmp_path / "log.csv", table, "%.9g", ",", header="t,r,u,y,p_A (bar),p_B (bar),p_S (bar)", comments="")
    named = loop(**{side: f"1e5 * `{name} (bar)`" for side, name in PRESSURES.items()})
    read = ss.read(tmp_path / "log.csv", named)
    np.testing.assert_allclose(read.channels["p_S"], log.channels["p_S"], rtol=1e-6)
    with pytest.raises(ss.ServoscopeError, match="p_A"):
        ss.read(tmp_path / "log.csv", loop(**PRESSURES))
