"""Logs of an axis with friction that goes to and fro, healthy or with a damaged ball of its screw."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy import signal

import servoscope as ss
from servoscope.signals import clean
from servoscope.signals.writers import write_recording

REPAIRED = 1.3  # u of `repaired_axis`, over u of its baseline

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


def repaired_axis(folder: Path) -> Path:
    """Write a service file that follows an axis whose motor was exchanged, and needs more current since."""
    ss.learn(LOOP, [axis(i, seconds=60.0) for i in range(2)]).save(folder / "axis.json")
    recording = axis(7, seconds=3000.0)
    write_recording(folder / "after.csv", ss.Recording(**{**vars(recording), "u": REPAIRED * recording.u}))
    config = folder / "hall.toml"
    config.write_text(
        'name = "hall"\n[service]\nlisten = ""\nlog = "error"\n[store]\nurl = "history.sqlite"\n'
        "[diagnosis]\nwindow_s = 60.0\nkeep_s = 200.0\nevery_s = 60.0\n"
        '[sources.line]\nkind = "replay"\nspeed = 50.0\n'
        '[assets.axis]\nbaseline = "axis.json"\nsource = "line"\nfiles = ["after.csv"]\n'
    )
    return config
