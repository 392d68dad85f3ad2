"""Healthy smooth motion, which is what machines do: whether it is learned, and true delays found."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np

import servoscope as ss
from accuracy.rig import SEEDS_PER_UNIT, loop
from accuracy.scenario import Numbers, Row, Scenario, Table
from servoscope.core.arrays import FloatArray
from servoscope.core.errors import RecordingError
from servoscope.learning.delay import check_delay
from servoscope.simulation.measurement import NOISE_U_STD, NOISE_Y_STD

STROKE = 0.05  # m on the rig, rad or so on an axis
SLOWEST_HZ = 0.5  # of the random motion
LINES = 40  # of the random motion
SECONDS = 60.0
NOISES = (0.1, 1.0, 3.0)  # times the paper's
MOTIONS = ("moves", "moves and rests", "random below 0.5 Hz")
SOFTER = 0.5  # of the proportional gain: with two further samples of delay the rig's own loop would be unstable
AXES = {
    "rig": "reference rig",
    "axis-2": "motor axis, order 2, without friction",
    "axis-3": "motor axis, order 3, without friction",
    "axis-2-unknown": "motor axis, order 2, no coefficients in the loop file",
    "axis-3-unknown": "motor axis, order 3, no coefficients in the loop file",
    "axis-2-friction": "motor axis, order 2, Coulomb friction",
}
RATES = {2: 250.0, 3: 500.0}
RIG_UNITS, AXIS_UNITS = 25, 12  # 150 healthy recordings of the rig and 72 of each axis
NOISE_SHARE = 0.01  # noise of y relative to its rms that one times the paper's noise is on the rig


def motion(kind: str, seconds: float, sample_rate: float, seed: int) -> FloatArray:
    """Return a smooth reference, shape (N,), within the stroke.

    Moves of 1 to 2.5 s between random places, each of the least jerk, 10 s^3 - 15 s^4 + 6 s^5 (Flash and Hogan, 1985),
    one after the other or with rests of 0.3 to 1.5 s; or a sum of sines of random phases and amplitudes.
    """
    rng, t = np.random.default_rng(seed), np.arange(round(seconds * sample_rate)) / sample_rate
    if kind.startswith("random"):
        f = rng.uniform(0.02, SLOWEST_HZ, LINES)
        phase, size = rng.uniform(0.0, 2.0 * np.pi, LINES), rng.normal(size=LINES)
        r = (size * np.sin(2.0 * np.pi * f * t[:, None] + phase)).sum(axis=1)
        return np.asarray(STROKE * r / np.abs(r).max())
    r, begin, place = np.zeros(len(t)), 0.0, 0.0
    while begin < seconds:
        lasts, to = rng.uniform(1.0, 2.5), rng.uniform(-STROKE, STROKE)
        s = np.clip((t - begin) / lasts, 0.0, 1.0)
        r = np.where(t >= begin, place + (to - place) * (10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5), r)
        begin, place = begin + lasts + (rng.uniform(0.3, 1.5) if "rests" in kind else 0.0), to
    return r


@functools.cache
def machine(name: str) -> ss.Loop:
    """Return the loop of the reference rig, or of a motor axis under PI control."""
    if name == "rig":
        made = loop()
        assert made.controller is not None, "the rig has a controller"
        softer = made.controller.model_copy(update={"k_p": SOFTER * made.controller.k_p})
        return made.model_copy(update={"controller": softer})
    order = 3 if "3" in name else 2
    coefficients = {"stiffness": 40.0, "viscous_friction": 2.0, "inertia": 0.02}
    coefficients |= {"jerk": 1e-4} if order == 3 else {}
    plant = {"kind": "polynomial", "order": order, "stiffness": True}
    if name.endswith("friction"):
        coefficients["coulomb_friction"] = 0.1
        plant |= {"friction": "coulomb", "sign_from": "reference"}
    settings = {
        "name": name,
        "sample_rate": RATES[order],
        "plant": plant | {"coefficients": coefficients},
        "controller": {"kind": "pi", "k_p": 40.0, "k_i": 200.0},
    }
    return ss.Loop.from_dict(settings)


@functools.cache
def loop_file(name: str) -> ss.Loop:
    """Return what the loop file says: the machine without delay, or nothing of its coefficients and controller."""
    made = machine(name)
    if not name.endswith("unknown"):
        return made
    plant = made.plant.model_copy(update={"coefficients": None})
    return made.model_copy(update={"plant": plant, "controller": None})


def job(seed: int, name: str) -> Numbers:
    """Judge the delay of healthy recordings, and of some that are one and two samples late, at one draw of each."""
    made, runs = machine(name), []
    for i, kind in enumerate(MOTIONS):
        for late in (0, 0, 1, 2):
            index = len(runs)
            draw = SEEDS_PER_UNIT * seed + index
            noise = NOISES[(seed + i + index) % len(NOISES)]
            true = made.model_copy(update={"delay": late / made.sample_rate})
            r = motion(kind, SECONDS, made.sample_rate, draw)
            y_std = NOISE_Y_STD if name == "rig" else NOISE_SHARE * float(r.std())
            u_std = NOISE_U_STD if name == "rig" else 0.1 * NOISE_SHARE
            recording, _ = ss.simulate(true, r, noise_u_std=noise * u_std, noise_y_std=noise * y_std, seed=draw)
            runs.append({"motion": kind, "late": late, "noise": noise} | judged(loop_file(name), recording))
    return {"runs": runs}


def judged(made: ss.Loop, recording: ss.Recording) -> Numbers:
    """Return whether a recording is refused, and the delay that it shows [samples]."""
    refused = False
    try:
        found, _ = check_delay(made, [recording])
    except RecordingError:
        refused = True
        found, _ = check_delay(made, [recording], accept=True)
    return {"refused": refused, "found": None if found is None else float(f"{found * made.sample_rate:.4g}")}


def rows(words: str, found: Sequence[Numbers]) -> list[Row]:
    """Show what was refused, and how far off the delays are that were found."""
    runs = [run for unit in found for run in unit["runs"]]
    cells = [words]
    for late in (0, 1, 2):
        own = [run for run in runs if run["late"] == late]
        refused = sum(run["refused"] for run in own)
        wrong = sum(run["found"] is not None and abs(run["found"] - late) > 0.5 for run in own)
        mark = "**" if (refused if late == 0 else wrong) else ""
        cells.append(f"{mark}{refused} of {len(own)}{mark}")
        cells.append(f"{sum(run['found'] is None for run in own)}")
    told = [abs(run["found"] - run["late"]) for run in runs if run["found"] is not None]
    return [(*cells, f"{max(told):.2g}" if told else "")]


SCENARIOS = tuple(
    Scenario(f"smooth/{name}", words, RIG_UNITS if name == "rig" else AXIS_UNITS, job, (name,), rows)
    for name, words in AXES.items()
)
TABLES = (
    Table(
        "smooth",
        (
            *("loop", "healthy: refused", "cannot tell", "one sample late: refused", "cannot tell"),
            *("two samples late: refused", "cannot tell", "largest error of a delay that is told [samples]"),
        ),
        SCENARIOS,
    ),
)
