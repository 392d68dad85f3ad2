"""Noise in y without a controller: bias of the coefficients of polynomial plants, and a pitch actuator with faults."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np
from public import pitch_turbine as pitch
from scipy.linalg import expm
from scipy.signal import lfilter

import servoscope as ss
from accuracy import smooth
from accuracy.rig import SEEDS_PER_UNIT
from accuracy.scenario import Numbers, Row, Scenario, Table
from servoscope.core.arrays import FloatArray
from servoscope.signals import clean

SECONDS, RATE = 180.0, 100.0
TURBULENCE = (0.5, 1.0, 1.5, 2.0)  # times that of the public benchmark
LEARNED = 4  # recordings of a unit whose bias is judged: one of 3 min scatters by more than a bias that matters
LEVELS_DB = (20, 10, 0)  # rms of y over that of its noise
W, XI = pitch.HEALTHY
FAULTS = {"air in oil": "air_in_oil", "low pressure": "low_pressure"}
LOOP = {
    "name": "pitch actuator",
    "sample_rate": RATE,
    "columns": {"reference": "beta_ref", "input": "beta_ref", "output": "beta"},
    "plant": {"kind": "polynomial", "order": 2, "stiffness": True},
    "monitor": {"cutoff": 3.0, "memory": 20.0, "frequencies": [0.1, 0.5, 1.0]},
    "faults": {name: pitch.ray(fault) for fault, name in FAULTS.items()},
}
TRUE = {"input": (1.0, 2.0 * XI / W, W**-2), "reference": (8.0, 2.0)}
COEFFICIENTS = {"input": ("stiffness", "viscous friction", "inertia"), "reference": ("viscous friction", "inertia")}
GAIN = 40.0  # of the P controller of the axis


def wind(duration_s: float, seed: int, turbulence: float) -> FloatArray:
    """Return the wind of the public benchmark with another turbulence, within the range of full load."""
    calm = pitch.make_wind(duration_s, seed)
    return np.asarray(np.clip(calm.mean() + turbulence * (calm - calm.mean()), 13.5, 24.0))


def actuator(fault: str, duration_s: float, seed: int, turbulence: float) -> ss.Recording:
    """Return blade 1 from the start of the turbine on; its two sensors are one of the mean's noise."""
    samples = round(duration_s * RATE)
    moved = pitch.run(
        wind(duration_s, seed, turbulence), *pitch.course(fault, samples), tuple(pitch.Turbine()), pitch.RATE
    )
    u, noise = moved[:, 0], pitch.NOISE / np.sqrt(2.0)
    y = moved[:, 1] + noise * np.random.default_rng(10_000 + seed).normal(size=samples)
    return clean(np.arange(samples) / RATE, u, u, y, name=f"{fault or 'healthy'} {seed}", sample_rate=RATE)


@functools.cache
def healthy_pitch() -> ss.Baseline:
    """Return the baseline of five winds of ten minutes."""
    return ss.learn(ss.Loop.from_dict(LOOP), [actuator("", 600.0, seed, 1.0) for seed in range(5)], force=True)


def pitch_job(seed: int, turbulence: float) -> Numbers:
    """Learn some recordings one by one, and diagnose a healthy one and both faults, all from other winds."""
    own = 3_000_000 + SEEDS_PER_UNIT * seed + round(10 * turbulence)
    loop = ss.Loop.from_dict(LOOP)
    learned = [ss.learn(loop, [actuator("", SECONDS, own + 100 * i, turbulence)], force=True) for i in range(LEARNED)]
    found: Numbers = {"error": [one.theta[2] / TRUE["input"][2] - 1.0 for one in learned]}
    found["std"] = [float(np.sqrt(one.covariance[2][2])) / TRUE["input"][2] for one in learned]
    found["instrument"] = all(one.recursion.instrument is not None for one in learned)
    healthy = ss.diagnose(healthy_pitch(), actuator("", 600.0, own + 5, turbulence))
    found["false"] = healthy.verdict in ("suspect", "fault")
    for i, (fault, wanted) in enumerate(FAULTS.items()):
        told = ss.diagnose(healthy_pitch(), actuator(fault, 600.0, own + 6 + i, turbulence))
        found[fault] = {"named": [one.name for one in told.faults] == [wanted]}
        if told.faults and found[fault]["named"]:
            true = LOOP["faults"][wanted]["inertia"]
            low, high = told.faults[0].interval
            found[fault] |= {"error": told.faults[0].ratio / true - 1.0, "held": low <= true <= high}
            found[fault]["late"] = told.intervals[0].onset_s[1] - pitch.ONSET_S
    return found


def motion(seed: int, kind: str) -> FloatArray:
    """Return motion of variance one, shape (N,): random below 1 Hz, or moves of the least jerk."""
    if kind == "moves":
        r = smooth.motion(kind, SECONDS, RATE, seed)
        return np.asarray((r - r.mean()) / r.std())
    a = np.exp(-2.0 * np.pi / RATE)
    slow = lfilter([1.0], np.poly([a, a, a]), np.random.default_rng(seed).normal(size=round(SECONDS * RATE) + 2000))
    return np.asarray(slow[2000:] / slow[2000:].std())


def drive(seed: int, source: str, level_db: float, kind: str = "random", colour_s: float = 0.0) -> ss.Recording:
    """Return a pitch drive whose command is u, or an axis behind a P controller that answers the noise of y.

    `colour_s`: time constant of the noise [s]; 0: white.
    """
    command, open_loop = motion(seed, kind), source == "input"
    lines = [[0.0, 1.0, 0.0], [-W * W, -2.0 * XI * W, W * W]] if open_loop else [[0.0, 1.0, 0.0], [0.0, -4.0, 0.5]]
    exact, x = expm(np.vstack([lines, np.zeros(3)]) / RATE), np.zeros(2)
    n = 10.0 ** (-level_db / 20.0) * np.random.default_rng(10_000 + seed).normal(size=len(command))
    if colour_s:
        a = float(np.exp(-1.0 / (colour_s * RATE)))
        n = lfilter([np.sqrt(1.0 - a * a)], [1.0, -a], n)
    u, y = np.empty_like(n), np.empty_like(n)
    for k, r in enumerate(command):
        y[k] = x[0] + n[k]
        u[k] = r if open_loop else GAIN * (r - y[k])
        x = exact[:2, :2] @ x + exact[:2, 2] * u[k]
    return clean(np.arange(len(n)) / RATE, u if open_loop else command, u, y, name=f"{seed}", sample_rate=RATE)


def bias_job(seed: int, source: str, level_db: float, kind: str = "random") -> Numbers:
    """Learn one recording; errors and stated deviations are relative."""
    plant = {"kind": "polynomial", "order": 2, "stiffness": source == "input"}
    loop = ss.Loop.from_dict({"sample_rate": RATE, "plant": plant, "monitor": {"cutoff": 3.0, "memory": 20.0}})
    learned = ss.learn(loop, [drive(2_000_000 + seed, source, level_db, kind)], force=True)
    true = np.array(TRUE[source])
    return {
        "error": (np.array(learned.theta) / true - 1.0).tolist(),
        "std": (np.sqrt(np.diag(learned.covariance_array())) / true).tolist(),
        "instrument": learned.recursion.instrument is not None,
    }


def bias_rows(source: str, words: str, found: Sequence[Numbers]) -> list[Row]:
    """Show, by coefficient, the mean error in stated deviations; refused recordings do not count."""
    used = [one for one in found if one["instrument"]]
    refused = f"{len(found) - len(used)} of {len(found)}"
    if not used:
        return [(words, "", "", "", "", "", refused)]
    error, std = np.array([one["error"] for one in used]), np.array([one["std"] for one in used])
    made = []
    for i, name in enumerate(COEFFICIENTS[source]):
        share = abs(error[:, i].mean()) / std[:, i].mean()
        held = np.mean(np.abs(error[:, i]) < 1.96 * std[:, i])
        mark = "**" if share > 1.0 / 3.0 else ""
        cells = (
            f"{100 * error[:, i].mean():.2g} %",
            f"{100 * error[:, i].std():.2g} %",
            f"{100 * std[:, i].mean():.2g} %",
        )
        made.append((words, name, *cells, f"{mark}{share:.2f}{mark}", f"{100 * held:.0f} %", refused))
    return made


def pitch_rows(words: str, found: Sequence[Numbers]) -> list[Row]:
    """Show bias, false alarms, and for each fault the share that is named, its size and its onset."""
    error, std = (np.ravel([one[name] for one in found]) for name in ("error", "std"))
    cells = [words, f"{100 * error.mean():.2g} ± {100 * error.std() / np.sqrt(len(error)):.2g} %"]
    cells += [
        f"{100 * np.mean(np.abs(error) < 1.96 * std):.0f} %",
        f"{sum(one['false'] for one in found)} of {len(found)}",
    ]
    for fault in FAULTS:
        named = [one[fault] for one in found if one[fault]["named"]]
        cells.append(f"{len(named)} of {len(found)}")
        late = np.abs([one["late"] for one in named])
        held = 100 * np.mean([one["held"] for one in named]) if named else 0.0
        cells += [f"{held:.0f} %", f"{np.median(late):.2g} s" if named else ""]
    return [tuple(cells)]


PITCH = tuple(
    Scenario(f"pitch/{level:g}", f"{level:g} times the turbulence", 25, pitch_job, (level,), pitch_rows)
    for level in TURBULENCE
)
SOURCES = {"input": "u is the command", "reference": "closed loop, r"}
BIAS = tuple(
    Scenario(
        f"noisy/{prefix}{source}-{level}", f"{words}{more}, {level} dB", 40, bias_job, (source, level, kind),
        functools.partial(bias_rows, source),
    )
    for kind, prefix, more in (("random", "", ""), ("moves", "moves-", ", moves"))
    for source, words in SOURCES.items()
    for level in LEVELS_DB
)  # fmt: skip
TABLES = (
    Table(
        "pitch",
        (
            *("wind", "bias of inertia, recordings of 3 min", "in its 95 %", "healthy: false", "air in oil named"),
            *("size in its 95 %", "median error of the onset", "low pressure named", "size in its 95 %"),
            "median delay of the onset behind the ramp's beginning",
        ),
        PITCH,
    ),
    Table(
        "noisy",
        (
            *("source of the instrument, rms of y over noise", "coefficient", "bias", "scatter", "stated deviation"),
            *("bias over stated deviation", "in its 95 %", "refused"),
        ),
        BIAS,
    ),
)
