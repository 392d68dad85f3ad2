"""One slide, logged at 250 Hz, 500 Hz and 1 kHz: what init, learn and diagnose make of each log.

    python benchmarks accuracy/log_rates [--seeds N] [--json]

The slide is that of tests/support/slide.py: a P-PI cascade at 2 kHz, which moves u between the samples of every one of
these logs. Two healthy logs of a minute; in the others Coulomb friction grows to 1.5 times half-way. Nothing is edited.
"""

from __future__ import annotations

import numpy as np
from belt_axis import COULOMB, INERTIA, VISCOUS
from slide import slide
from tables import Table, parser, show

import servoscope as ss

RATES, LEARNED, SECONDS, RATIO = (250.0, 500.0, 1000.0), 2, 60.0, 1.5
TRUTH = {"inertia": INERTIA, "viscous_friction": VISCOUS, "coulomb_friction": COULOMB}


def judged(rate: float, seeds: int) -> tuple[str, dict[str, float], list[tuple[str, float, float, float]]]:
    """Return the hold that was chosen, the coefficients, and of each log name, size and its interval."""
    healthy = [slide(seed, SECONDS, rate) for seed in range(LEARNED)]
    baseline = ss.learn(ss.init(healthy).loop, healthy)
    assert baseline.axis is not None, "a slide is an axis"
    found = []
    for seed in range(100, 100 + seeds):
        (fault,) = ss.diagnose(baseline, slide(seed, SECONDS, rate, RATIO)).faults or (None,)
        found.append(
            ("nothing", np.nan, np.nan, np.nan) if fault is None else (fault.name, fault.ratio, *fault.interval)
        )
    return baseline.loop.hold, baseline.axis.coefficients, found


def main() -> None:
    """Print the table."""
    command = parser(__doc__)
    command.add_argument("--seeds", type=int, default=4)
    given = command.parse_args()
    rows, of_rates = [], []
    for rate in RATES:
        hold, theta, found = judged(rate, given.seeds)
        of_rates.append([theta[name] for name in TRUTH] + [value for one in found for value in one[1:]])
        low, ratio, high = (np.mean([one[k] for one in found]) for k in (2, 1, 3))
        names = ", ".join(sorted({one[0] for one in found}))
        own = (f"{theta[name]:.4f}" for name in TRUTH)
        rows.append((f"{rate:g}", hold, *own, names, f"{ratio:.4f} [{low:.4f} {high:.4f}]"))
    values = np.array(of_rates)
    spread = float(np.max(np.ptp(values, axis=0) / np.abs(values).mean(axis=0)))
    heads = ("rate [Hz]", "hold", *TRUTH, "named", f"size of {RATIO:g}")
    truth = ", ".join(f"{name} {value:g}" for name, value in TRUTH.items())
    note = (
        f"Truth: {truth}. Sizes are means over {given.seeds} logs. Largest difference between rates, of any "
        f"coefficient, size or end of an interval: {100.0 * spread:.2f} %."
    )
    show(
        [Table("One slide at three rates", note, heads, tuple(rows))], given.json, {"spread": f"{100.0 * spread:.2f} %"}
    )


if __name__ == "__main__":
    main()
