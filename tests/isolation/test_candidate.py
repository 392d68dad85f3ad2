"""Records of what isolation finds, written and read back."""

from __future__ import annotations

import math

from servoscope.isolation.candidate import FaultEstimate


def test_an_end_that_nothing_bounds_is_read_back_from_json() -> None:
    fault = FaultEstimate(name="leakage", parameter="C_ie", ratio=3.0, interval=(0.5, math.inf))
    text = fault.model_dump_json()
    assert '"interval":[0.5,null]' in text
    assert FaultEstimate.model_validate_json(text) == fault
