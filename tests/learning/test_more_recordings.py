"""More healthy recordings never make a baseline find less."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from axis_logs import LOOP, axis

import servoscope as ss
from servoscope.diagnosis.diagnose import largest_statistic_ratio
from servoscope.evidence.examination import Examination

COUNTS = 2, 3, 4, 5, 6, 8, 12  # of healthy recordings
HELD_OUT = 12


def faulty() -> list[ss.Recording]:
    """Return faults of three kinds from small to large: a damaged ball, more friction one way, a weaker motor."""
    sizes = np.geomspace(0.02, 0.3, 6).tolist()
    made = [axis(200 + k, ripple=size) for k, size in enumerate(sizes)]
    made += [axis(300 + k, level=size) for k, size in enumerate(sizes)]
    weaker = [axis(400 + k) for k in range(len(sizes))]
    return [*made, *(replace(rec, u=(1.0 + size) * rec.u) for rec, size in zip(weaker, sizes, strict=True))]


def test_more_healthy_recordings_find_no_less_at_equal_false_alarms() -> None:
    """Added one by one; the limit is moved to the largest score of the same healthy recordings, which none learned."""
    healthy, others, faults = [axis(k) for k in range(max(COUNTS))], [axis(100 + k) for k in range(HELD_OUT)], faulty()
    found = []
    for count in COUNTS:
        baseline = ss.learn(LOOP, healthy[:count])
        scores = [largest_statistic_ratio(Examination.from_recording(baseline, rec)) for rec in (*others, *faults)]
        found.append(sum(score > max(scores[:HELD_OUT]) for score in scores[HELD_OUT:]))
    assert found == sorted(found), found
