"""Several changes in one recording: what held when, against a slow oracle and recordings whose truth is known."""

from __future__ import annotations

import io
from importlib.resources import files
from itertools import pairwise

import numpy as np
import pytest
from rich.console import Console

import servoscope as ss
from servoscope.cli.render.diagnosis import print_diagnosis
from servoscope.isolation.ml.hypothesis import fit_hypothesis
from servoscope.isolation.ml.plant_sequence import SequenceCost, likeliest_sequence
from servoscope.isolation.ml.window import ChangeProfile, RefitWindow
from servoscope.simulation import FaultEvent, reference

SECONDS = 60.0


def simulated(loop: ss.Loop, seed: int, *faults: FaultEvent) -> ss.Recording:
    return ss.simulate(loop, reference("multisine", SECONDS, loop.sample_rate), faults=faults, seed=seed)[0]


@pytest.fixture(scope="module")
def baseline() -> ss.Baseline:
    loop = ss.Loop.load(str(files("servoscope") / "simulation" / "reference-rig.toml"))
    return ss.learn(loop, [simulated(loop, 0)])


@pytest.fixture(scope="module")
def stepped(baseline: ss.Baseline) -> ss.Diagnosis:
    faults = FaultEvent("C_ie", 1.1, 20.0), FaultEvent("C_ie", 1.3, 40.0)
    return ss.diagnose(baseline, simulated(baseline.loop, 7, *faults))


@pytest.fixture(scope="module")
def healed(baseline: ss.Baseline) -> ss.Diagnosis:
    faults = FaultEvent("p_s", 0.9, 20.0), FaultEvent("p_s", 1.0, 40.0)
    return ss.diagnose(baseline, simulated(baseline.loop, 7, *faults))


def predictors(window: RefitWindow, *ratios: float) -> list:
    nothing, step = np.zeros(window.nuisance_count), ChangeProfile(0)
    return [window.predictor(nothing, ["C_ie"], np.log([ratio]), step) for ratio in ratios]


def test_a_sequence_costs_what_a_plain_kalman_filter_leaves(baseline: ss.Baseline) -> None:
    recording = simulated(baseline.loop, 3)
    window = RefitWindow.from_recording(baseline, recording, 0, 400)
    plants, starts = predictors(window, 1.0, 2.0, 0.5), [0, 150, 290]
    x, expected = np.zeros(plants[0].A.shape[-1]), 0.0
    for (first, end), plant in zip(pairwise([*starts, 400]), plants, strict=True):
        A, b, late, c, K, S = (part[-1] for part in plant)
        for k in range(first, end):
            j = min(k, len(S) - 1)
            if not k:
                x = c * window.y[0] / (c @ c)
            e = window.y[k] - c @ x
            expected += e**2 / S[j] + np.log(S[j] / window.healthy.S[0, j])
            x = A @ x + b * window.u[k] + late * window.u[max(k - 1, 0)] + K[j] * e
    assert SequenceCost(window, window.healthy, plants)(starts) == pytest.approx(expected, rel=1e-9)


def test_the_likeliest_sequence_finds_each_plant_where_it_was(baseline: ss.Baseline) -> None:
    recording = simulated(baseline.loop, 3, FaultEvent("C_ie", 2.0, 2.0), FaultEvent("C_ie", 1.0, 4.0))
    window = RefitWindow.from_recording(baseline, recording, 0, 600)
    path = likeliest_sequence(window, predictors(window, 1.0, 0.5, 2.0), np.full(3, 60.0))
    assert set(path.tolist()) == {0, 2}
    changes = np.flatnonzero(np.diff(path)) + 1
    assert np.abs(changes - [200, 400]).max() <= 60  # a late switch may win at first


def test_a_size_of_which_nothing_shows_is_left_where_it_was(baseline: ss.Baseline) -> None:
    """A change at the very end has a gradient of zero: the search divided by its length, and went on with no number."""
    window = RefitWindow.from_recording(baseline, simulated(baseline.loop, 3), 0, 400)
    leakage = next(fault for fault in baseline.plant.faults if fault.parameter == "C_ie")
    d, starts = np.zeros(window.nuisance_count), [np.array([0.1])]
    found = fit_hypothesis(window, [leakage], ChangeProfile(400), d, starts, free=False)
    assert found.x == pytest.approx([0.1]) and np.isfinite(found.cost)


def test_two_steps_are_two_intervals_with_their_sizes(stepped: ss.Diagnosis) -> None:
    sizes = [one.faults[0] for one in stepped.intervals]
    assert [fault.name for fault in sizes] == ["leakage", "leakage"]
    for fault, truth in zip(sizes, (1.1, 1.3), strict=True):
        assert fault.interval[0] <= truth <= fault.interval[1]
    for one, truth in zip(stepped.intervals, (20.0, 40.0), strict=True):
        assert one.onset_s[0] <= truth <= one.onset_s[2] < truth + 1.0
    first, last = stepped.intervals
    assert first.end_interval_s == last.onset_s
    assert last.end_s is None
    assert stepped.faults == last.faults


def test_a_fault_that_heals_ends_when_it_did(healed: ss.Diagnosis) -> None:
    (one,) = healed.intervals
    assert [fault.name for fault in one.faults] == ["pump"]
    assert one.faults[0].interval[0] <= 0.9 <= one.faults[0].interval[1]
    low, likely, high = one.end_interval_s
    assert low <= 40.0 <= high < 41.0
    assert one.end_s == likely
    assert healed.summary.startswith("Fault: pump from 20.0 to 40.0 s (p_s 0.90")
    assert healed.summary.endswith("; healthy again since 40.0 s.")


def test_one_change_stays_one_interval(baseline: ss.Baseline) -> None:
    found = ss.diagnose(baseline, simulated(baseline.loop, 7, FaultEvent("C_ie", 1.2, 20.0, 15.0)))
    (one,) = found.intervals  # a drift is no staircase
    assert one.end_s is None
    assert one.end_interval_s is None
    assert found.refit.over_s == pytest.approx(15.0, abs=3.0)


@pytest.mark.slow
def test_an_intermittent_fault_is_told_each_time(baseline: ss.Baseline) -> None:
    times = ((1.2, 15.0), (1.0, 22.0), (1.2, 30.0), (1.0, 38.0), (1.2, 47.0))
    found = ss.diagnose(baseline, simulated(baseline.loop, 7, *(FaultEvent("C_ie", *each) for each in times)))
    assert [[fault.name for fault in one.faults] for one in found.intervals] == [["leakage"]] * 3
    for one, begin in zip(found.intervals, (15.0, 30.0, 47.0), strict=True):
        assert one.onset_s[0] <= begin <= one.onset_s[2]
    assert [one.end_s is None for one in found.intervals] == [False, False, True]


def test_intervals_survive_json_and_are_printed_one_per_line(stepped: ss.Diagnosis, healed: ss.Diagnosis) -> None:
    for diagnosis in (stepped, healed):
        assert ss.Diagnosis.model_validate_json(diagnosis.model_dump_json()) == diagnosis
        out = io.StringIO()
        print_diagnosis(Console(file=out, width=140), diagnosis)
        rows = [line for line in out.getvalue().splitlines() if "×" in line and "(" in line]
        assert sum("leakage ×" in row or "pump ×" in row for row in rows) >= len(diagnosis.intervals)
