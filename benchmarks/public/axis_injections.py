"""EMPS, a measured axis: changes of random size, kind and time added to u, and what the refit of an axis says of them.

    python benchmarks/public/axis_injections.py [--data DIR] [--count N] [--seed S] [--json]

DATA_EMPS learned as a plant of kind ``axis``; `count` changes into each of the two recordings, 5 to 50 % either way,
the sizes even in their logarithms, between a quarter and three quarters of the recording. The force that a change adds
is that of the learned coefficients; speed and acceleration are hardly smoothed (11 ms), or inertia comes out too small.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np
from tables import Table, parse_with_data, parser, show

import servoscope as ss
from public.servoscope_detector import ROOT

KINDS = ("payload", "motor_constant", "dry_friction", "lubrication")
BANDS = ((0.05, 0.1), (0.1, 0.2), (0.2, 0.5))
POINTS = 0.02  # added to both ends of an interval of a size, beside the interval as stated


@dataclass(frozen=True)
class Injection:
    """A change and what was said of it."""

    size: float  # the ratio minus 1
    found: bool
    named: bool  # whether it alone was named
    wrong: bool  # whether something else was
    inside: tuple[bool, bool, bool] | None  # size in its interval, in the wider one, onset in its; None unless named


def changed(
    recording: ss.Recording, learned: dict[str, float], gain: float, kind: str, size: float, at: int
) -> ss.Recording:
    """Return a recording whose u holds what a change would have asked for."""
    from scipy.signal import savgol_filter

    T = 1.0 / recording.sample_rate
    v, a = (savgol_filter(recording.y, 11, 3, deriv=order, delta=T) for order in (1, 2))
    forces = {
        "payload": learned["inertia"] * a,
        "motor_constant": gain * recording.u,
        "dry_friction": learned["coulomb_friction"] * np.sign(v) * (np.abs(v) > 1e-3),
        "lubrication": learned["viscous_friction_forward"] * np.maximum(v, 0.0)
        + learned["viscous_friction_backward"] * np.minimum(v, 0.0),
    }
    since = np.arange(recording.samples) >= at
    return replace(recording, u=recording.u + size * forces[kind] / gain * since)


def inject(baseline: ss.Baseline, recording: ss.Recording, count: int, rng: np.random.Generator) -> list[Injection]:
    """Return what was said of random changes of one recording."""
    assert baseline.axis is not None
    made = []
    for i in range(count):
        kind, way = KINDS[i % len(KINDS)], rng.choice([-1.0, 1.0])
        size = float(way * np.exp(rng.uniform(np.log(BANDS[0][0]), np.log(BANDS[-1][1]))))
        at = int(rng.uniform(0.25, 0.75) * recording.samples)
        judged = changed(recording, baseline.axis.coefficients, baseline.loop.plant.input_gain, kind, size, at)
        diagnosis = ss.diagnose(baseline, judged)
        names, inside = [fault.name for fault in diagnosis.faults], None
        if names == [kind] and diagnosis.onset_s is not None:
            low, high = diagnosis.faults[0].interval
            begin, _, end = diagnosis.onset_s
            wide = low - POINTS <= 1.0 + size <= high + POINTS
            inside = low <= 1.0 + size <= high, wide, begin <= float(recording.t[at]) <= end
        found = diagnosis.verdict == "fault"
        made.append(Injection(size, found, inside is not None, bool(names) and inside is None, inside))
    return made


def row(name: str, made: Sequence[Injection]) -> tuple[str, ...]:
    """Return the cells of one recording."""
    bands = [[one for one in made if low <= abs(one.size) < high] for low, high in BANDS]
    found = [f"{sum(one.found for one in band)} of {len(band)}" for band in bands]
    told = [one for one in made if one.found]
    named = [one.inside for one in made if one.inside is not None]
    shares = [f"{sum(each)} of {len(named)}" for each in zip(*named, strict=True)]
    right = sum(one.named for one in told)
    return (name, *found, f"{right} of {len(told)}", str(sum(one.wrong for one in told)), *shares)


def main() -> None:
    """Run the command line of this process."""
    command = parser(__doc__)
    command.add_argument("--count", type=int, default=100, help="changes per recording")
    command.add_argument("--seed", type=int, default=1)
    given = parse_with_data(command, "real/emps")
    folder = given.data / "real" / "emps"
    settings = ss.Loop.load(ROOT / "examples" / "emps.toml").to_dict()
    terms = ["viscous_by_direction", "coulomb", "offset"]
    settings["plant"] = {"kind": "axis", "terms": terms, "input_gain": settings["plant"]["input_gain"]}
    loop = ss.Loop.from_dict(settings)
    recordings = [ss.read(folder / f"{name}.mat", loop) for name in ("DATA_EMPS", "DATA_EMPS_PULSES")]
    baseline, rng = ss.learn(loop, recordings[:1]), np.random.default_rng(given.seed)
    rows = tuple(row(one.name, inject(baseline, one, given.count, rng)) for one in recordings)
    note = f"{given.count} changes per recording, seed {given.seed}. Intervals are those of the changes named right."
    heads = ("recording", "found of 5 to 10 %", "of 10 to 20 %", "of 20 to 50 %", "named right", "named wrong")
    heads += ("size in 95 %", "with 2 points", "onset in 95 %")
    show([Table("EMPS: changes added to u", note, heads, rows)], given.json)


if __name__ == "__main__":
    main()
