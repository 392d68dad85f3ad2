"""The limit of evidence, and the rule that decides."""

from __future__ import annotations

import numpy as np
import pytest

from servoscope.core.verdict import JudgeEvidence, decide, evidence_limit, joint_evidence


def test_the_limit_is_that_of_alpha_or_of_the_recordings_left_out() -> None:
    assert evidence_limit([-3.0, -2.5, 1.0, -3.5]) == pytest.approx(4.605170185988092)
    assert evidence_limit([-3.0, 6.0, 1.0, -3.5]) == pytest.approx(8.99573227355399)
    assert evidence_limit([]) == pytest.approx(np.log(100.0))


def test_a_further_healthy_recording_is_above_the_limit_as_rarely_as_promised() -> None:
    """Exchangeable recordings of a judge that is four times too sure of itself: its own limit fails, this one holds."""
    rng = np.random.default_rng(0)
    left_out, further = 4.0 * rng.exponential(size=(20_000, 30)), 4.0 * rng.exponential(size=20_000)
    limits = np.array([evidence_limit(row) for row in left_out[:4000]])
    assert (further > evidence_limit([])).mean() > 0.2
    assert (further[:4000] > limits).mean() <= 0.031  # 1/(n + 1), less what the margin above the largest adds


def test_one_recording_is_suspect_unless_it_is_sure() -> None:
    limit = 5.0
    kinds = [decide(JudgeEvidence("a", nats), limit).kind for nats in (4.9, 5.1, 14.9, 15.1)]
    assert kinds == ["healthy", "suspect", "suspect", "fault"]
    assert decide(JudgeEvidence("a", 5.1, inside=True), limit).kind == "fault"
    assert decide(JudgeEvidence("a", 5.1), limit, before="suspect").kind == "fault"
    assert decide(JudgeEvidence("a", 5.1), limit, before="healthy").kind == "suspect"
    assert decide(JudgeEvidence("a", 4.9), limit, before="fault").kind == "healthy"


def test_many_judges_share_the_false_alarms() -> None:
    rng = np.random.default_rng(1)
    nats = -np.log(rng.uniform(size=(20_000, 6)))
    joint = [joint_evidence([JudgeEvidence(str(k), x) for k, x in enumerate(row)], 6) for row in nats[:5000].tolist()]
    assert np.mean([one.nats > evidence_limit([]) for one in joint]) <= 0.014
    assert joint_evidence([], 6).nats < 0.0


def test_how_sure_is_never_above_what_so_many_recordings_allow() -> None:
    verdict = decide(JudgeEvidence("a", 30.0), evidence_limit([6.0, 1.0, 2.0]), recordings=3)
    assert verdict.guaranteed == 0.25
    assert np.log(verdict.by_model) == pytest.approx(-(30.0 - (6.0 - np.log(4.0))))
