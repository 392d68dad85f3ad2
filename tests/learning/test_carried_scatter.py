"""Scatter between recordings that a baseline after a repair takes over from the one that it replaces."""

from __future__ import annotations

import numpy as np
import pytest

import servoscope as ss
from servoscope.evidence.examination import Examination
from servoscope.learning.detectability import forecast_changes
from servoscope.learning.scatter import carry_scatter
from servoscope.simulation import FaultEvent, simulate
from servoscope.simulation.tutorial import AXIS, motion

LOOP = ss.Loop.from_dict(AXIS)
DAYS = (0.92, 0.98, 1.02, 1.08)  # viscous friction, relative


def recorded(seed: int, viscous: float, coulomb: float = 1.0) -> ss.Recording:
    events = [FaultEvent.parse(f"viscous_friction={viscous}@0"), FaultEvent.parse(f"coulomb_friction={coulomb}@0")]
    return simulate(LOOP, motion(seed), faults=events, noise_u_std=0.02, noise_y_std=5e-6, seed=seed)[0]


@pytest.fixture(scope="module")
def days() -> ss.Baseline:
    return ss.learn(LOOP, [recorded(i, viscous) for i, viscous in enumerate(DAYS)])


@pytest.fixture(scope="module")
def repaired(days: ss.Baseline) -> ss.Baseline:
    """Learned from one stretch after a repair, with other days known from before."""
    return ss.learn(LOOP, recorded(20, 1.2), earlier=days)


def test_the_scatter_is_relative_and_counts_until_there_are_as_many_recordings(
    days: ss.Baseline, repaired: ss.Baseline
) -> None:
    at = days.names.index("viscous_friction")
    own = np.array(days.scatter.between)[at][at]
    ratio = repaired.theta[at] / days.theta[at]
    assert repaired.scatter.carried_from == repaired.scatter_from == len(DAYS)
    assert 1.1 < ratio < 1.4 and repaired.scatter.carried[at] >= own * ratio**2
    assert repaired.covariance[at][at] >= 2.0 * repaired.scatter.carried[at]
    alone = ss.learn(LOOP, recorded(20, 1.2))
    assert not alone.scatter.carried and alone.covariance[at][at] < 0.1 * repaired.covariance[at][at]
    again = carry_scatter(repaired, np.array(repaired.theta))
    assert again == pytest.approx(np.array(repaired.scatter.carried))


def test_another_day_after_a_repair_is_healthy_and_a_fault_is_found(repaired: ss.Baseline) -> None:
    assert ss.diagnose(repaired, recorded(21, 1.2 * 0.93)).verdict == "healthy"
    dry = ss.diagnose(repaired, recorded(22, 1.2 * 0.93, coulomb=1.8))
    assert dry.verdict == "fault" and "dry friction" in dry.summary


def test_the_covariance_falls_when_the_estimate_has_settled_live_too(repaired: ss.Baseline) -> None:
    assert any(repaired.scatter.transient)
    early, late = repaired.covariance_after(np.array([0.0, np.inf]))
    assert np.array_equal(early, repaired.covariance_array()) and (np.diag(late) <= np.diag(early)).all()
    recording = recorded(23, 1.25)
    monitor = ss.Monitor(repaired)
    _, trace = monitor.run(monitor.init(), recording.r, recording.u, recording.y, restart=recording.restart)
    same = ss.Monitor(repaired.model_copy(update={"scatter": repaired.scatter.model_copy(update={"transient": ()})}))
    _, without = same.run(same.init(), recording.r, recording.u, recording.y, restart=recording.restart)
    exam = Examination.from_recording(repaired, recording)
    assert len(trace.t) == exam.evaluations
    changed = np.flatnonzero(trace.statistic != without.statistic)
    assert len(changed) and exam.estimates.updates[changed[0]] > repaired.settled_after
    for k in (10, exam.evaluations - 1):
        C = exam.estimates.S[k] + repaired.covariance_after(exam.estimates.updates[k])
        assert trace.covariance[k] == pytest.approx(C, rel=1e-6, abs=1e-12)


def test_what_more_days_bring_is_foretold(days: ss.Baseline, repaired: ss.Baseline) -> None:
    """Four more of the same days: the smallest change falls about as much as was foretold."""
    foretold = forecast_changes(days, len(DAYS))
    learned = ss.learn(LOOP, [recorded(i, viscous) for i, viscous in enumerate(2 * DAYS)], earlier=days)
    reached = {each.name: each.change for each in learned.detectability.changes}
    before, after = foretold["viscous_friction"]
    assert after < before and reached["viscous_friction"] == pytest.approx(after, rel=0.3)
    gained = forecast_changes(repaired, 10)
    assert all(after <= before for before, after in gained.values())


def test_a_copy_starts_from_the_first_machine(days: ss.Baseline) -> None:
    copy = ss.learn(LOOP, recorded(30, 1.0), population=[days])
    assert copy.scatter.carried_from == len(DAYS)
    assert any(
        "recordings differ is taken from" in str(note) and "features from 4 on" in str(note) for note in copy.notes
    )
