"""Guards must not fire at sound logs: coarse encoders, staircases, units beside a fault, loads, huge spikes."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile.logs import Count, try_all

import servoscope as ss
from servoscope.core.arrays import FloatArray
from servoscope.evidence.signals import find_signal_defect
from servoscope.learning.axis_fit import MIN_NOISE_SAMPLES_PER_COLUMN, AxisRegression, fit_axis_noise, rest_speed
from servoscope.learning.proposal import init
from servoscope.models.plants.axis import AxisPlant
from servoscope.signals import clean
from servoscope.simulation import FaultEvent, simulate

PLANT: dict[str, Any] = {
    "kind": "axis",
    "terms": ["viscous", "coulomb", "offset"],
    "coefficients": {"inertia": 2.0, "viscous_friction": 8.0, "coulomb_friction": 3.0, "offset": 0.5},
}
LOOP = ss.Loop.from_dict({"sample_rate": 100.0, "plant": {"kind": "axis"}})
T = np.arange(2000) / 100.0


def moved(seed: int, *faults: FaultEvent, r: FloatArray | None = None) -> ss.Recording:
    loop = ss.Loop.from_dict(
        {"sample_rate": 100.0, "plant": PLANT, "controller": {"kind": "pi", "k_p": 400.0, "k_i": 0.0}}
    )
    motion = 0.5 * np.sin((2.0 + 0.2 * seed) * T) + 0.2 * np.sin(5.1 * T) if r is None else r
    return simulate(loop, motion, faults=faults, noise_u_std=0.05, noise_y_std=1e-5, seed=seed)[0]


@pytest.fixture(scope="module")
def baseline() -> ss.Baseline:
    return ss.learn(LOOP, [moved(seed) for seed in range(2)])


@pytest.fixture
def case(shared_data: Path, tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """A copy of a small log as people have them."""
    return Path(shutil.copytree(shared_data / "cases" / request.param, tmp_path / request.param))


@pytest.mark.parametrize("case", ["tick-encoder-traceback"], indirect=True)
def test_an_encoder_of_few_ticks_leaves_samples_for_the_noise(case: Path) -> None:
    """Truth: inertia 0.01141, viscous friction 0.02853, Coulomb friction 37.2."""
    proposal = init(case / "healthy.csv", "t=t,r=goal_position,u=present_current,y=present_position")
    recording = ss.read(case / "healthy.csv", proposal.loop)
    axis = ss.learn(proposal.loop, [recording]).axis
    assert axis is not None
    expected = {"inertia": 0.01141, "viscous_friction": 0.02853, "coulomb_friction": 37.2}
    assert {name: axis.coefficients[name] for name in expected} == pytest.approx(expected, rel=0.02)


def test_the_noise_of_a_coarse_position_keeps_thirty_samples_a_column() -> None:
    from servoscope.isolation.ml.axis_window import axis_signals

    recording = moved(1)
    coarse = replace(recording, y=np.round(recording.y / 0.01) * 0.01)
    plant = LOOP.plant
    assert isinstance(plant, AxisPlant)
    signals = axis_signals(LOOP, coarse, 1)
    regression, slow = AxisRegression.of(plant, signals), rest_speed([signals])
    _, e, _ = regression.regress(fit_axis_noise([regression], slow), slow)
    assert len(e) >= MIN_NOISE_SAMPLES_PER_COLUMN * len(regression.columns)


@pytest.mark.parametrize("case", ["open-loop-staircase"], indirect=True)
def test_steps_of_an_experiment_are_not_stuck(case: Path) -> None:
    """The gain is 0.8 from 30 s on, which three steps of 0.4 Hz hardly tell from another weight."""
    loop = init(case / "healthy.csv").loop
    learned = ss.learn(loop, [ss.read(case / f"{name}.csv", loop) for name in ("healthy", "healthy2")])
    diagnosis = ss.diagnose(learned, ss.read(case / "gain08_from_half.csv", loop))
    assert diagnosis.verdict == "fault" and diagnosis.candidates[0].name == "motor_constant"
    assert diagnosis.candidates[0].faults[0].ratio == pytest.approx(1.25, rel=0.06)
    assert diagnosis.onset_s is not None and diagnosis.onset_s[0] < 30.0 < diagnosis.onset_s[2]


def test_a_controller_that_stops_within_its_log_is_stuck() -> None:
    recording = moved(3)
    defect = find_signal_defect(replace(recording, u=np.where(T < 12.0, recording.u, recording.u[1200])))
    assert defect is not None and defect.begin == 1200
    # a weak drive that rests at its turning point: u hardly changes, so y need not
    resting = np.where((T > 5.0) & (T < 7.0), recording.y[500], recording.y)
    held = np.where((T > 5.0) & (T < 7.0), recording.u[500], recording.u)
    assert find_signal_defect(replace(recording, y=resting, u=held)) is None
    assert find_signal_defect(replace(recording, y=resting)) is not None


def test_learn_leaves_out_a_recording_with_a_defect_and_says_so() -> None:
    recordings = [moved(0), replace(moved(1), u=np.where(T < 12.0, moved(1).u, moved(1).u[1200]), name="broken")]
    learned = ss.learn(LOOP, recordings)
    assert [source.name for source in learned.sources] == [recordings[0].name]
    assert any("broken is left out: from 12.0 s on u stays" in str(note) for note in learned.notes)


def test_a_counter_wraps_away_from_the_reference_at_every_rate() -> None:
    k = np.arange(600)
    r = np.where(k // 60 % 2 > 0, 1.0, -1.0)
    noise = 1e-3 * np.random.default_rng(1).normal(size=k.size)
    for rate in (1.0, 10.0, 20.0):
        late = ss.read({"t": k / rate, "r": r, "u": r, "y": np.roll(r, 20) + noise})
        assert find_signal_defect(late) is None
        ramp = np.sin(0.02 * k)
        wrapped = (ramp + noise + 0.6) % 1.2 - 0.6
        defect = find_signal_defect(ss.read({"t": k / rate, "r": ramp, "u": np.cos(0.02 * k), "y": wrapped}))
        assert defect is not None


def test_a_wrong_unit_or_sign_beside_a_fault_is_told_and_the_fault_is_named(baseline: ss.Baseline) -> None:
    faulty = moved(7, FaultEvent("coulomb_friction", 1.5, 8.0))
    for changed, words in (
        (replace(faulty, u=faulty.u / 1000.0), "times 1000"),
        (replace(faulty, u=-faulty.u), "opposite sign"),
        (replace(faulty, y=faulty.y * 180.0 / np.pi), "times 0.0174533"),
    ):
        diagnosis = ss.diagnose(baseline, changed)
        assert [fault.name for fault in diagnosis.faults] == ["dry_friction"]
        assert diagnosis.faults[0].ratio == pytest.approx(1.5, rel=0.05)
        assert any(words in str(warning.description) for warning in diagnosis.warnings)


def test_a_load_that_makes_the_loop_lag_exchanges_nothing(baseline: ss.Baseline) -> None:
    heavy = ss.diagnose(baseline, moved(5, FaultEvent("inertia", 8.0, 0.0)))
    assert "exchanged" not in str(heavy.headline)
    recording = moved(5)
    assert "exchanged" in str(ss.diagnose(baseline, replace(recording, r=recording.y, y=recording.r)).headline)


def test_a_huge_spike_is_dropped_at_a_step_of_the_reference_too(baseline: ss.Baseline) -> None:
    recording = moved(4, r=0.3 * np.sign(np.sin(0.9 * T)) + 0.3 * np.sin(2.3 * T))
    step = int(np.argmax(np.abs(np.diff(recording.r)))) + 1
    for rows in (slice(step, step + 1), slice(500, 511)):
        u = recording.u.copy()
        u[rows] = 1e9
        cleaned = clean(recording.t, recording.r, u, recording.y, sample_rate=100.0)
        assert np.abs(cleaned.u).max() < 1e6
        assert [defect.kind for defect in cleaned.defects] == ["spike"]


def test_a_signal_in_an_absurd_unit_is_assessed_as_in_its_own() -> None:
    recording = moved(4)
    plain, huge = (ss.assess(replace(recording, u=factor * recording.u)) for factor in (1.0, 1e120))
    assert huge.verdict == plain.verdict


def test_logs_and_loop_files_as_nobody_wants_them_are_refused_in_one_line() -> None:
    count = Count()
    try_all(count, seed=5, logs=10, loops=20, longest_s=2.0)
    assert count.broken == []
    assert sum(count.answers.values()) > 60
