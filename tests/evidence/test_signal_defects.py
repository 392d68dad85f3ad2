"""Signals that are not what the loop file says: told in their own words with the remedy, and never a fault's name."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

import servoscope as ss
from servoscope.core.errors import RecordingError
from servoscope.evidence.signals import Correction, begins_wrong, find_signal_defect
from servoscope.models.loop import Loop
from servoscope.simulation import FaultEvent, reference, simulate

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
from accuracy.signal_defects import DEFECTS, LOOPS, baseline, healthy, stuck
from accuracy.signal_defects import loop as loop_of

Recording = ss.Recording


@pytest.fixture(scope="module")
def machines() -> dict[str, tuple[ss.Baseline, Recording]]:
    """A baseline and a further healthy recording of each loop."""
    return {name: (baseline(name), healthy(name, 2)) for name in LOOPS}


@pytest.mark.parametrize("defect", DEFECTS)
@pytest.mark.parametrize("name", LOOPS)
def test_a_diagnosis_says_what_is_wrong_and_names_no_fault(
    machines: dict[str, tuple[ss.Baseline, Recording]], name: str, defect: str
) -> None:
    learned, recording = machines[name]
    spoil, text = DEFECTS[defect]
    diagnosis = ss.diagnose(learned, spoil(recording))
    assert diagnosis.verdict == "undetermined" and not diagnosis.faults
    assert text in str(diagnosis.headline)
    assert diagnosis.warnings[-1].kind == "signals"


@pytest.mark.parametrize("name", LOOPS)
def test_sound_signals_have_no_defect(machines: dict[str, tuple[ss.Baseline, Recording]], name: str) -> None:
    learned, recording = machines[name]
    assert find_signal_defect(recording) is None
    assert ss.diagnose(learned, recording).verdict == "healthy"


def test_a_fault_before_a_sensor_sticks_keeps_its_name(machines: dict[str, tuple[ss.Baseline, Recording]]) -> None:
    learned, _ = machines["rig"]
    loop = learned.loop
    r = reference("multisine", 40.0, loop.sample_rate)
    faulty, _ = simulate(loop, r, faults=[FaultEvent("leakage", 1.3, 5.0)], seed=3)
    diagnosis = ss.diagnose(learned, stuck("y", faulty))
    assert [fault.name for fault in diagnosis.faults] == ["leakage"]
    assert "stays exactly the same" in str(diagnosis.warnings[-1].description)


@pytest.mark.parametrize(
    ("defect", "words"),
    [
        ("y in mm", "y is in another unit: times 0.001"),
        ("r and y in mm", "u times 1000, or r and y times 0.001, fit the plant"),
        ("u in mA", "u times 0.001, or r and y times 1000, fit the plant"),
        ("r and y exchanged", "r and y are exchanged"),
        ("u and y exchanged", "u and y are exchanged"),
        ("y stuck", "y stays exactly the same"),
        ("a counter that wraps", "a counter wraps"),
    ],
)
def test_learn_refuses_them(defect: str, words: str) -> None:
    with pytest.raises(RecordingError, match=words):
        ss.learn(loop_of("rig"), [DEFECTS[defect][0](healthy("rig", 1))])


def test_a_step_after_the_dead_time_of_the_loop_is_no_counter_that_wraps() -> None:
    r = np.where(np.arange(2000) // 200 % 2 > 0, 1.0, -1.0)
    noise = 1e-3 * np.random.default_rng(1).normal(size=2000)

    def late(samples: int) -> ss.Recording:
        return ss.read({"t": np.arange(2000) / 100.0, "r": r, "u": r, "y": np.roll(r, samples) + noise})

    assert find_signal_defect(late(6)) is None  # a hobby servo of which no delay was declared
    assert find_signal_defect(late(30)) is None  # nor is one that answers later still, for it goes towards r
    assert find_signal_defect(late(30), delay_s=0.3) is None


def test_a_slow_loop_that_answers_after_two_samples_is_not_stuck() -> None:
    """At 0.1 Hz a second is less than a sample: y rests exactly until it answers a step of the set point."""
    k = np.arange(600)
    r = np.where(k // 60 % 2 > 0, 1.0, -1.0)
    late = np.where((k - 2) // 60 % 2 > 0, 1.0, -1.0)
    y = np.round(lfilter([0.3], [1.0, -0.7], late), 2)
    recording = ss.read({"t": 10.0 * k, "r": r, "u": r - y, "y": y})
    assert find_signal_defect(recording) is None
    defect = find_signal_defect(replace(recording, y=np.where(k < 300, y, y[300])))
    assert defect is not None and defect.begin <= 300


def test_a_rest_before_the_command_is_not_counted_as_stuck() -> None:
    """y rests exactly for three seconds, and breaks away 0.3 s after the command; frozen at 6 s it is stuck."""
    t = np.arange(1500) / 100.0
    r = np.where(t < 3.0, 0.0, np.sin(t - 3.0))
    y = np.where(t < 3.3, 0.0, np.sin(t - 3.3))
    recording = ss.read({"t": t, "r": r, "u": r, "y": y})
    assert find_signal_defect(recording) is None
    defect = find_signal_defect(replace(recording, y=np.where(t < 6.0, y, y[600])))
    assert defect is not None and defect.begin == 600


def test_a_unit_is_wrong_from_the_first_motion_on(machines: dict[str, tuple[ss.Baseline, Recording]]) -> None:
    learned, recording = machines["rig"]
    correction = Correction(factors=(1.0, 1.0, 1.0 / 60.0))
    for begin, wrong in ((0, True), (recording.samples // 2, False)):
        y = np.where(np.arange(recording.samples) < begin, 1.0, 60.0) * recording.y
        spoiled = replace(recording, y=y)
        assert begins_wrong(learned.pipeline(), np.array(learned.theta), spoiled, correction) == wrong


@pytest.mark.parametrize("folder", ["qube", "emps", "eha_pump"])
def test_measured_signals_are_sound(folder: str, shared_data: Path) -> None:
    loop = Loop.load(Path(__file__).parents[2] / "examples" / f"{folder.replace('_', '-')}.toml")
    for file in sorted((shared_data / "real" / folder).glob("*.csv"))[:6]:
        assert find_signal_defect(ss.read(file, loop)) is None, file.name
