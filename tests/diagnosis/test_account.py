"""One limit for all judges: what few healthy recordings allow, two recordings in a row, and lists of recordings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import servoscope as ss
from servoscope.baseline.threshold import NARROW_PRIOR, WIDE_PRIOR, robust_limit, score_evidence
from servoscope.diagnosis.account import Account, limit_evidence


def recording(seed: int, gain: float = 1.0) -> ss.Recording:
    """Return 40 s of a machine whose two coefficients scatter by 3 % between recordings."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 40.0, 0.01)
    y = np.sin(2.0 * t) + 0.5 * np.sin(5.3 * t + 1.0)
    v, a = np.gradient(y, t), np.gradient(np.gradient(y, t), t)
    friction, inertia = 1.0 + 0.03 * rng.normal(size=2)
    u = gain * (friction * v + 0.1 * inertia * a) + 0.05 * rng.normal(size=t.size)
    data = {"t": t, "r": y, "u": u, "y": y + 1e-4 * rng.normal(size=t.size)}
    return replace(ss.read(data, LOOP), name=f"{seed}")


LOOP = ss.Loop.from_dict(
    {
        "sample_rate": 100.0,
        "columns": {"time": "t", "reference": "r", "input": "u", "output": "y"},
        "plant": {"kind": "polynomial", "order": 2},
        "monitor": {"cutoff": 5.0, "memory": 5.0},
    }
)


@pytest.fixture(scope="module")
def baseline() -> ss.Baseline:
    return ss.learn(LOOP, [recording(seed) for seed in range(5)])


@pytest.mark.parametrize("prior", [WIDE_PRIOR, NARROW_PRIOR])
def test_the_evidence_of_a_limit_is_that_of_its_false_alarms(prior: object) -> None:
    scores = np.exp(np.random.default_rng(2).normal(size=6)).tolist()
    for false_alarms in (0.3, 0.01, 1e-5):
        limit = robust_limit(scores, false_alarms, prior)  # type: ignore[arg-type]
        evidence = score_evidence(limit, scores, prior)  # type: ignore[arg-type]
        assert evidence == pytest.approx(-np.log(false_alarms), rel=1e-6)
    assert limit_evidence(1.0, 0.01, 6) == pytest.approx(np.log(100.0))


def test_a_second_recording_in_a_row_is_a_fault(baseline: ss.Baseline) -> None:
    changed = [recording(100 + k, gain=1.25) for k in range(3)]
    alone = [ss.diagnose(baseline, one) for one in changed]
    assert {one.verdict for one in alone} == {"suspect"}
    assert alone[0].summary.startswith("Suspect: this recording is unlike the healthy ones")
    assert alone[0].explanation[-1].startswith("At most 1 in 6 healthy recordings would look like this")
    told = ss.diagnose(baseline, [recording(50), *changed])
    assert [one.verdict for one in told] == ["healthy", "suspect", "fault", "fault"]
    assert ss.diagnose(baseline, changed[0], before="suspect").verdict == "fault"
    assert ss.diagnose(baseline, recording(101, gain=4.0)).verdict == "fault"  # three times the limit


def test_healthy_recordings_that_few_others_taught_are_healthy(baseline: ss.Baseline) -> None:
    told = [ss.diagnose(baseline, recording(seed)).verdict for seed in range(50, 80)]
    assert told.count("healthy") >= 29 and "fault" not in told


def test_limits_of_an_account_are_those_of_the_account_that_they_make(baseline: ss.Baseline) -> None:
    account = Account(baseline)
    again = Account(account.shared(40.0))
    assert again.limit == pytest.approx(account.limit) and again.recordings == 5
    assert again.shared(40.0).thresholds.statistic == pytest.approx(account.shared(40.0).thresholds.statistic)
    largest = max(scores.largest for scores in (account.coefficients, account.features) if scores is not None)
    assert account.limit >= largest - account.share
