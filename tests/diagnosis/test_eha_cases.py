"""The main job on recordings of an independent simulator: verdicts, sizes, detection times, other references."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servoscope.baseline.baseline import Baseline
from servoscope.detection.trace import Trace
from servoscope.diagnosis.diagnose import diagnose_with_trace
from servoscope.diagnosis.result import Diagnosis
from servoscope.learning.learn import learn_baseline
from servoscope.models.loop import Loop
from servoscope.signals.readers import read
from servoscope.simulation import reference, simulate

LEARNED_ON = {
    "profile": "profile_healthy_0.csv",
    "multisine": "multisine_healthy_2.csv",
    "trapezoid": "trapezoid_healthy_4.csv",
}
NAMES = {"p_s": "pump", "C_ie": "leakage", "b_p": "friction", "beta": "contamination"}
SIZES = {"p_s": 0.005, "C_ie": 0.02, "b_p": 0.05, "beta": 0.05}
WITHIN_S = {"p_s": 1.0, "C_ie": 2.0, "b_p": 2.0, "beta": 2.0}


@cache
def _examined(folder: Path, learned_on: str, file: str) -> tuple[Diagnosis, Trace]:
    loop = _loop()
    return diagnose_with_trace(_baseline(folder, learned_on), read(folder / file, loop))


@cache
def _baseline(folder: Path, file: str) -> Baseline:
    return learn_baseline(_loop(), [read(folder / file, _loop())])


@cache
def _loop() -> Loop:
    return Loop.load(Path(__file__).parents[2] / "src/servoscope/simulation/reference-rig.toml")


def _cases(truth: dict[str, dict[str, Any]], reference: str) -> list[dict[str, Any]]:
    return [case for case in truth.values() if case["reference"] == reference and case["file"] != LEARNED_ON[reference]]


@pytest.mark.parametrize("kind", ["profile", "multisine", "trapezoid"])
def test_healthy_stays_healthy_and_nothing_is_said_before_the_fault(
    kind: str, eha_cases: Path, eha_truth: dict[str, dict[str, Any]]
) -> None:
    for case in _cases(eha_truth, kind):
        diagnosis, trace = _examined(eha_cases, LEARNED_ON[kind], case["file"])
        if not case["ratios"]:
            assert diagnosis.verdict == "healthy", case["file"]
        before = trace.t < 30.0 if case["ratios"] else np.full(len(trace.t), True)
        assert trace.statistic[before].max() < trace.threshold, case["file"]


@pytest.mark.parametrize("kind", ["profile", "multisine", "trapezoid"])
def test_faults_are_found_in_time_and_their_onset_is_right(
    kind: str, eha_cases: Path, eha_truth: dict[str, dict[str, Any]]
) -> None:
    missed = []
    for case in _cases(eha_truth, kind):
        if case["ratios"]:
            diagnosis, _ = _examined(eha_cases, LEARNED_ON[kind], case["file"])
            limit = 3.0 if kind == "trapezoid" else min(WITHIN_S[p] for p in case["ratios"])
            assert diagnosis.verdict == "fault"
            assert diagnosis.detected_at_s is not None and diagnosis.onset_s is not None
            assert 30.0 <= diagnosis.detected_at_s <= 30.0 + limit, case["file"]
            if kind != "trapezoid":  # which stands still at 30 s: nobody can tell the onset there
                outside = max(diagnosis.onset_s[0] - 30.0, 30.0 - diagnosis.onset_s[2], 0.0)
                missed.append(outside)
    assert max(missed, default=0.0) == 0.0


@pytest.mark.parametrize("kind", ["profile", "multisine"])
def test_single_faults_are_named_with_their_size(
    kind: str, eha_cases: Path, eha_truth: dict[str, dict[str, Any]]
) -> None:
    for case in _cases(eha_truth, kind):
        if len(case["ratios"]) == 1:
            ((parameter, ratio),) = case["ratios"].items()
            diagnosis, _ = _examined(eha_cases, LEARNED_ON[kind], case["file"])
            (fault,) = diagnosis.faults
            assert (fault.name, fault.parameter) == (NAMES[parameter], parameter)
            assert fault.ratio == pytest.approx(ratio, rel=SIZES[parameter]), case["file"]
            assert fault.interval[0] < fault.ratio < fault.interval[1]


def test_friction_on_a_trapezoid_is_friction_or_ambiguous_with_contamination(eha_cases: Path) -> None:
    for learned_on in (LEARNED_ON["trapezoid"], LEARNED_ON["profile"]):
        diagnosis, _ = _examined(eha_cases, learned_on, "trapezoid_b_px20_30.csv")
        assert diagnosis.candidates[0].name == "friction"
        if not diagnosis.faults:
            assert {c.name for c in diagnosis.candidates[:2]} == {"friction", "contamination"}


def test_two_faults_at_once_are_both_named_with_their_sizes(eha_cases: Path) -> None:
    for learned_on in (LEARNED_ON["multisine"], LEARNED_ON["profile"]):
        diagnosis, _ = _examined(eha_cases, learned_on, "multisine_p_sx0.9_C_iex1.3_32.csv")
        assert [fault.name for fault in diagnosis.faults] == ["pump", "leakage"]
        for fault, ratio in zip(diagnosis.faults, (0.9, 1.3), strict=True):
            assert fault.ratio == pytest.approx(ratio, rel=0.01)
            assert fault.interval[0] < ratio < fault.interval[1]
        assert diagnosis.refit is not None
        assert diagnosis.refit.recursive[0].name == "unknown", "which knows single faults only"


def test_dirty_recording_is_healthy_and_every_defect_is_told(eha_cases: Path) -> None:
    diagnosis, _ = _examined(eha_cases, LEARNED_ON["profile"], "dirty_healthy.csv")
    assert diagnosis.verdict == "healthy"
    told = {(warning.kind, round(warning.from_s, 1)) for warning in diagnosis.warnings}
    assert {("nan", 9.0), ("repeat", 15.0), ("gap", 15.0), ("gap", 20.0), ("spike", 40.4)} <= told
    assert any(warning.kind == "order" and abs(warning.from_s - 30.4) < 0.1 for warning in diagnosis.warnings)


def test_a_baseline_of_one_reference_serves_another(eha_cases: Path, eha_truth: dict[str, dict[str, Any]]) -> None:
    """Learned on a profile, the other references are healthy where they are, and never named wrongly."""
    for case in (c for c in eha_truth.values() if c["reference"] != "profile"):
        diagnosis, _ = _examined(eha_cases, LEARNED_ON["profile"], case["file"])
        if not case["ratios"]:
            assert diagnosis.verdict == "healthy", case["file"]
        else:
            assert diagnosis.verdict in ("fault", "undetermined")
            named = {fault.parameter for fault in diagnosis.faults}
            assert not named or named == set(case["ratios"]), case["file"]
    loop = _loop()
    small, _ = simulate(loop, 0.5 * reference("profile", 60.0, loop.sample_rate), seed=3)
    assert diagnose_with_trace(_baseline(eha_cases, LEARNED_ON["profile"]), small)[0].verdict == "healthy"


def test_a_recording_without_motion_is_undetermined_not_healthy(eha_cases: Path) -> None:
    loop = _loop()
    still, _ = simulate(loop, np.zeros(6000), seed=5)
    short, _ = simulate(loop, reference("profile", 60.0, loop.sample_rate)[:40], seed=5)
    for recording in (still, short):
        diagnosis, _ = diagnose_with_trace(_baseline(eha_cases, LEARNED_ON["profile"]), recording)
        assert diagnosis.verdict == "undetermined"
        assert any(warning.kind == "power" for warning in diagnosis.warnings)
