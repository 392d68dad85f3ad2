"""The logs of the tutorial: a motor axis that carries parts, on four days, as a drive exports them."""

from __future__ import annotations

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.models.loop import Loop
from servoscope.simulation.closed_loop import simulate
from servoscope.simulation.faults import FaultEvent

SAMPLE_RATE = 200.0  # Hz
DURATION_S = 60.0
# day -> its seed, and what breaks: on Friday the guide runs dry
DAYS = {"monday": (1, ""), "tuesday": (2, ""), "wednesday": (3, ""), "friday": (4, "viscous_friction=1.25@40")}
AXIS = {
    "name": "axis",
    "sample_rate": SAMPLE_RATE,
    "plant": {
        "kind": "polynomial",
        "order": 2,
        "friction": "coulomb",
        "offset": True,
        # V s²/m, V s/m, V, V: a motor behind a gear
        "coefficients": {"inertia": 1.0, "viscous_friction": 10.0, "coulomb_friction": 0.5, "offset": 0.3},
    },
    "controller": {"kind": "pi", "k_p": 150.0, "k_i": 50.0},
}
HEADER = "Axis;X1\nCycle time;5 ms\nTime (ms);Set position (mm);Actual position (mm);Motor voltage (V)\n"


def tutorial_log(day: str) -> str:
    """Return the log of a day, one of `DAYS`, as text of the file: the same at each call."""
    seed, fault = DAYS[day]
    events = [FaultEvent.parse(fault)] if fault else []
    loop = Loop.from_dict(AXIS)
    log = simulate(loop, motion(seed), faults=events, noise_u_std=0.02, noise_y_std=5e-6, seed=seed)[0]
    rows = zip(1e3 * log.t, 1e3 * log.r, 1e3 * log.y, log.u, strict=True)
    return HEADER + "".join(f"{t:.0f};{r:.3f};{y:.3f};{u:.4f}\n" for t, r, y, u in rows)


def motion(seed: int) -> FloatArray:
    """Return a set position [m] of one minute, another for each seed: from station to station, with short stops.

    Each move is the one with the least jerk (Flash and Hogan 1985).
    """
    rng = np.random.default_rng(seed)
    wanted = round(DURATION_S * SAMPLE_RATE)
    position, pieces, samples = 0.0, [], 0
    while samples < wanted:
        station = rng.uniform(-0.08, 0.28)
        length = max(0.25, 1.6 * abs(station - position) / rng.uniform(0.6, 1.2))  # s
        s = np.arange(0.0, 1.0, 1.0 / (SAMPLE_RATE * length))
        move = position + (station - position) * (10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5)
        stop = np.full(int(rng.uniform(0.1, 0.6) * SAMPLE_RATE), station)
        pieces += [move, stop]
        position, samples = station, samples + move.size + stop.size
    return np.concatenate(pieces)[:wanted]
