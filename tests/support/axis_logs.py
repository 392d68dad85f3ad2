"""Logs of an axis with friction that goes to and fro, healthy or with a damaged ball of its screw."""

from __future__ import annotations

import numpy as np
from scipy import signal

import servoscope as ss
from servoscope.signals import clean

RATE, PERIOD_S = 50.0, 4.0
LOOP = ss.Loop.from_dict(
    {
        "name": "axis",
        "sample_rate": RATE,
        "plant": {"kind": "polynomial", "order": 2, "friction": "coulomb", "offset": True, "sign_from": "reference"},
        "monitor": {"cutoff": 2.0, "memory": 4.0, "frequencies": [0.5, 1.0, 2.0]},
    }
)


def axis(seed: int, seconds: float = 33.0, ripple: float = 0.0, speed: float = 1.0, level: float = 0.0) -> ss.Recording:
    """Return an axis that goes to and fro with rests; friction scatters by 3 % from recording to recording.

    `ripple`: amplitude of what a damaged ball adds to u at 15 Hz while the axis goes forward, behind the cutoff;
    `level`: what is added to u while it goes backward.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * RATE)) / RATE
    phase = (speed * t / PERIOD_S) % 1.0
    v = np.select([phase < 0.4, (phase > 0.5) & (phase < 0.9)], [1.0, -1.0], 0.0)
    v = signal.lfilter([0.2], [1.0, -0.8], v) * speed
    r = np.cumsum(v) / RATE
    a = np.gradient(v) * RATE
    force = 0.2 * a + 0.5 * v + (0.4 + 0.012 * rng.standard_normal()) * np.tanh(v / 0.02) + 0.1
    force += ripple * np.sin(2.0 * np.pi * 15.0 * t) * (v > 0.05) + level * (v < -0.05)
    u = force + 0.02 * rng.standard_normal(len(t))
    y = r - 0.01 * force + 1e-4 * rng.standard_normal(len(t))
    return clean(t, r, u, y, name=f"axis-{seed}", sample_rate=RATE)
