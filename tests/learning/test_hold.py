"""How u runs between the samples: the likelier of the two, so that nothing depends on the rate of a log."""

from __future__ import annotations

import numpy as np
import pytest
from belt_axis import COULOMB
from slide import CONTROL_RATE, slide

import servoscope as ss
from servoscope.learning.hold import likelier_hold

TERMS = ["viscous", "coulomb", "offset"]


def loop_at(rate: float, **settings: object) -> ss.Loop:
    return ss.Loop.from_dict({"sample_rate": rate, **settings, "plant": {"kind": "axis", "terms": TERMS}})


def test_sizes_do_not_depend_on_the_rate_of_the_log() -> None:
    found = []
    for rate in (250.0, 500.0, 1000.0):
        baseline = ss.learn(loop_at(rate, monitor={"cutoff": 8.0}), [slide(0, 30.0, rate)])
        assert baseline.loop.hold == "foh" and any("hold" in str(note) for note in baseline.notes)
        (fault,) = ss.diagnose(baseline, slide(10, 30.0, rate, ratio=1.5)).faults
        assert fault.name == "dry_friction" and fault.interval is not None
        assert baseline.axis is not None
        theta = [baseline.axis.coefficients[name] for name in ("inertia", "coulomb_friction")]
        assert theta[1] == pytest.approx(COULOMB, rel=0.01)
        found.append([*theta, fault.ratio, *fault.interval])
    assert np.ptp(found, axis=0) / np.mean(found, axis=0) == pytest.approx(0.0, abs=0.01)


def test_u_is_held_where_the_log_is_as_fast_as_the_controller_and_where_that_is_said() -> None:
    fast, slow = loop_at(CONTROL_RATE), loop_at(250.0)
    found = likelier_hold(fast, [ss.read(slide(1, 10.0, CONTROL_RATE), fast)])
    assert found is not None and found.hold == "zoh"
    log = ss.read(slide(1, 10.0, 250.0), slow)
    assert likelier_hold(slow, [log]) is not None
    assert likelier_hold(loop_at(250.0, hold="zoh"), [log]) is None


def test_init_writes_it_with_its_reason() -> None:
    proposal = ss.init(slide(2, 30.0, 250.0))
    assert proposal.loop.hold == "foh"
    (line,) = [line for line in proposal.to_toml().splitlines() if line.startswith("hold")]
    assert line.startswith('hold = "foh"') and "likelihood" in line
