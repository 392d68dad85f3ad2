"""Days that scatter must not hide a step within one recording, and must not make healthy ones faulty."""

from __future__ import annotations

from importlib.resources import files

import pytest

import servoscope as ss
from servoscope.diagnosis.own_past import examine_by_own_past
from servoscope.evidence.examination import Examination
from servoscope.simulation import FaultEvent, reference

DAYS = 1.04, 0.95, 1.06, 0.97  # of the leakage: about 4 to 5 % of scatter
TODAY = 0.98

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def loop() -> ss.Loop:
    return ss.Loop.load(str(files("servoscope") / "simulation" / "reference-rig.toml"))


def simulated(loop: ss.Loop, seed: int, *faults: FaultEvent) -> ss.Recording:
    return ss.simulate(loop, reference("multisine", 60.0, loop.sample_rate), faults=faults, seed=seed)[0]


@pytest.fixture(scope="module")
def baseline(loop: ss.Loop) -> ss.Baseline:
    return ss.learn(loop, [simulated(loop, i, FaultEvent("C_ie", day, 0.0)) for i, day in enumerate(DAYS)])


def test_a_step_within_one_recording_is_told_to_a_percent(baseline: ss.Baseline) -> None:
    faults = FaultEvent("C_ie", TODAY, 0.0), FaultEvent("C_ie", 1.1 * TODAY, 35.0)
    recording = simulated(baseline.loop, 10, *faults)
    assert not Examination.from_recording(baseline, recording).alarm.any()  # the days alone hide it
    found = ss.diagnose(baseline, recording)
    (fault,) = found.faults
    assert fault.name == "leakage"
    assert fault.interval[0] <= 1.1 <= fault.interval[1] < 1.12
    assert found.onset_s[0] <= 35.0 <= found.onset_s[2]
    assert [warning.kind for warning in found.warnings].count("own_past") == 1


def test_another_healthy_day_is_healthy(baseline: ss.Baseline) -> None:
    recording = simulated(baseline.loop, 11, FaultEvent("C_ie", TODAY, 0.0))
    exam = Examination.from_recording(baseline, recording)
    own = examine_by_own_past(exam)
    assert own is not None
    assert not own.alarm.any()
    assert ss.diagnose(baseline, recording).verdict == "healthy"


def test_a_change_that_is_older_than_the_recording_is_left_to_the_days(baseline: ss.Baseline) -> None:
    exam = Examination.from_recording(baseline, simulated(baseline.loop, 12, FaultEvent("C_ie", 2.0, 0.0)))
    assert exam.alarm.any()
    assert examine_by_own_past(exam) is None


def test_a_baseline_of_one_day_is_asked_alone(loop: ss.Loop) -> None:
    single = ss.learn(loop, [simulated(loop, 0)])
    assert examine_by_own_past(Examination.from_recording(single, simulated(loop, 1))) is None
