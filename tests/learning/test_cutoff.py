"""The band that logs are fitted in: much the same for all logs of one machine, up to where the motion explains u."""

from __future__ import annotations

import numpy as np
import pytest
from belt_axis import belt_axis

import servoscope as ss
from servoscope.learning.inspection.cutoff import measure_cutoff
from servoscope.signals import clean


def test_logs_of_one_axis_with_dry_friction_agree() -> None:
    logs = [belt_axis(seed, 40.0) for seed in range(6)]
    cutoffs = [measure_cutoff(clean(**log), False) for log in logs]
    assert max(cutoffs) < 1.5 * min(cutoffs) and min(cutoffs) > 5.0


@pytest.mark.parametrize("edge_hz", [2.0, 5.0])
def test_beyond_what_the_motion_explains_ends_the_band(edge_hz: float) -> None:
    rng, rate = np.random.default_rng(1), 100.0
    t = np.arange(6000) / rate
    f = np.arange(0.1, 12.0, 0.1)
    phase = rng.uniform(0.0, 2.0 * np.pi, f.size)
    angle = 2.0 * np.pi * f[:, None] * t + phase[:, None]
    size = 1.0 / (1.0 + f**2)[:, None]
    y = (size * np.cos(angle)).sum(axis=0)
    inside = f <= edge_hz
    w = 2.0 * np.pi * f[:, None]
    force = (size * (2.0 - 0.01 * w**2) * np.cos(angle))[inside].sum(axis=0)
    other = rng.uniform(0.0, 2.0 * np.pi, f.size)[:, None]
    force += (size * (2.0 - 0.01 * w**2) * np.cos(angle + other))[~inside].sum(axis=0)
    recording = clean(t, np.roll(y, 1), force, y)
    assert 0.7 * edge_hz < measure_cutoff(recording, False) < 1.3 * edge_hz


def test_without_a_reference_the_noise_of_a_fast_valve_ends_no_band() -> None:
    rng = np.random.default_rng(2)
    command = np.cumsum(rng.standard_normal(3000)) * 0.1 + rng.standard_normal(3000)
    position = np.zeros(3000)
    for k in range(1, 3000):
        position[k] = position[k - 1] + 0.5 * (command[k - 1] - position[k - 1])
    recording = clean(np.arange(3000.0), command, command, position)
    assert ss.inspect(recording).suggested_cutoff_hz == pytest.approx(0.1)
