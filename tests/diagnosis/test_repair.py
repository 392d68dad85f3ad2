"""A machine that was worn and is repaired within the recording: healthy, with a finding in the past."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import servoscope as ss
from servoscope.service.assets.examination import StoredDiagnosis, diagnose_blocks, examine_blocks
from servoscope.service.sources.block import Block
from servoscope.simulation import FaultEvent, reference, simulate
from servoscope.simulation.tutorial import AXIS

PLANT: dict[str, Any] = {"kind": "axis", "terms": ["viscous", "coulomb"], "coefficients": {
    "inertia": 1.0, "viscous_friction": 10.0, "coulomb_friction": 2.0}}  # fmt: skip
WORN = FaultEvent("coulomb_friction", 1.5, 0.0), FaultEvent("coulomb_friction", 1.0, 28.0)


@pytest.fixture(scope="module")
def baseline() -> ss.Baseline:
    loop = ss.Loop.from_dict({**AXIS, "plant": PLANT})
    return ss.learn(loop, [moved(loop, seed) for seed in range(2)])


def moved(loop: ss.Loop, seed: int, *faults: FaultEvent) -> ss.Recording:
    t = np.arange(10_000) / 200.0
    r = 0.1 * np.sin(3.0 * t) + 0.05 * np.sin(7.0 * t)
    return simulate(loop, r, seed=seed, faults=faults, noise_u_std=5e-3, noise_y_std=1e-5)[0]


def test_an_axis_that_was_worn_until_its_repair(baseline: ss.Baseline) -> None:
    found = ss.diagnose(baseline, moved(baseline.loop, 7, *WORN))
    assert found.verdict == "healthy"
    assert found.summary.startswith(
        "Healthy, with a finding in the past: dry friction from the start or before to 28.0 s"
    )
    assert found.summary.endswith("; healthy again since 28.0 s.")
    (interval,) = found.intervals
    (fault,) = interval.faults
    assert fault.interval[0] <= 1.5 <= fault.interval[1]
    assert interval.end_interval_s is not None and interval.end_interval_s[0] <= 28.0 <= interval.end_interval_s[2]
    assert "since when" not in str(found).splitlines()[0]


def test_a_linear_plant_that_was_worn_until_its_repair() -> None:
    loop = ss.Loop.load(str(files("servoscope") / "simulation" / "reference-rig.toml"))
    r = reference("multisine", 60.0, loop.sample_rate)
    worn = FaultEvent("C_ie", 1.5, 0.0), FaultEvent("C_ie", 1.0, 28.0)
    found = ss.diagnose(ss.learn(loop, [simulate(loop, r, seed=0)[0]]), simulate(loop, r, seed=7, faults=worn)[0])
    assert (found.verdict, found.intervals[0].end_s) == ("healthy", pytest.approx(28.0, abs=0.1))
    assert "leakage" in found.summary


def test_the_headline_of_a_repaired_asset_becomes_healthy(baseline: ss.Baseline) -> None:
    """The window that holds the repair raises no fault, and the next one, behind it, is healthy."""
    recording = moved(baseline.loop, 7, *WORN)
    signals = np.array([recording.t, recording.r, recording.u, recording.y])

    def live(first: int, end: int) -> StoredDiagnosis:
        return examine_blocks(baseline, "axis", [Block.from_signals("axis", 0, signals[:, first:end])])

    assert live(0, 4800).verdict == "fault"
    assert live(1600, 9600).recovering
    assert live(5700, 10_000).verdict == "healthy"
    full = diagnose_blocks(baseline, "axis", [Block.from_signals("axis", 0, signals)])
    assert full.verdict == "healthy" and full.headline.key == "diagnosis.repaired"
    assert "to 1970-01-01 00:00:28" in full.summary


def test_several_changes_of_an_axis_have_names_sizes_and_times(baseline: ss.Baseline) -> None:
    course = [("coulomb_friction", 1.5, 12.0), ("inertia", 1.25, 24.0), ("coulomb_friction", 1.0, 38.0)]
    several = [FaultEvent(*each) for each in (*course, ("inertia", 1.0, 38.0))]
    found = ss.diagnose(baseline, moved(baseline.loop, 7, *several))
    assert found.verdict == "fault"
    first, both = found.intervals
    assert {fault.name: fault.ratio for fault in first.faults} == pytest.approx({"dry_friction": 1.5}, rel=0.01)
    assert {fault.name: fault.ratio for fault in both.faults} == pytest.approx(
        {"dry_friction": 1.5, "payload": 1.25}, rel=0.01
    )
    for at, dates in ((12.0, first.onset_s), (24.0, both.onset_s), (38.0, both.end_interval_s)):
        assert dates is not None and dates[0] <= at <= dates[2] and dates[2] - dates[0] < 3.0
    assert {moved.name for moved in both.coefficients} >= {"inertia", "coulomb_friction"}
    assert "healthy again since 3" in found.summary
    assert ss.Diagnosis.model_validate_json(found.model_dump_json()) == found


def test_a_baseline_from_before_has_no_changes_and_says_so(baseline: ss.Baseline, tmp_path: Path) -> None:
    baseline.save(tmp_path / "axis.json")
    assert ss.Baseline.load(tmp_path / "axis.json") == baseline
    assert baseline.axis is not None
    before = baseline.model_copy(update={"axis": baseline.axis.model_copy(update={"changes": None})})
    warnings = ss.diagnose(before, moved(baseline.loop, 7)).warnings
    assert any(warning.kind == "changes" and "learn again" in warning.message for warning in warnings)
