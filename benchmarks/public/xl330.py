"""XL330, a hobby servo with a pendulum: eight raw files under one baseline, each judged by what the others taught.

    python benchmarks public/xl330 [--data DIR] [--json]

The loop file is what `init` writes. In four of the files the motor is switched off after 2 s, and the
pendulum swings freely. Changed recordings have `GAIN` times the u from `CHANGED_S` on: a motor that has become weaker
under a controller that has become as much stronger.
"""

from __future__ import annotations

from pathlib import Path

from tables import Table, parse_with_data, parser, show

import servoscope as ss
from public.servoscope_detector import OURS, with_gain
from public.simple_detectors import detectors, judge
from servoscope.core.verdict import FOUND
from servoscope.learning.axis_fit import fit_axis
from servoscope.learning.proposal import propose_columns
from servoscope.signals.readers import list_channels

AUTHORS = 71.7  # gravity over inertia with the authors' rotor [1/s^2] (Rhoban, BAM)
GAIN = 2.0
CHANGED_S = 1.0
WINDOW_S = 2.0
RATES = 185.9, 200.0  # Hz, beside the proposed one: what is learned must not hang on it


def proposed_loop(files: list[Path]) -> ss.Loop:
    """Return the loop that `init` proposes with --resample, for the files are logged at two rates."""
    columns = propose_columns(files[0], list_channels(files[0]), None).model_copy(update={"resample": True})
    return ss.init(files, columns).loop


def with_axis(loop: ss.Loop, terms: tuple[str, ...], rate: float) -> ss.Loop:
    """Return the loop as an axis with these terms, at another rate."""
    settings = loop.to_dict() | {"plant": {"kind": "axis", "terms": list(terms)}, "sample_rate": rate}
    return ss.Loop.from_dict(settings)


def main() -> None:
    """Run the command line of this process."""
    given = parse_with_data(parser(__doc__), "real/xl330")
    folder = given.data / "real" / "xl330"
    files = sorted(folder.glob("*.parquet"))
    loop = proposed_loop(files)
    proposed = loop.plant.terms
    runs = [ss.read(path, loop) for path in files]
    values = {"terms": ", ".join(term for term in proposed if term != "offset")}

    rows = []
    others = ("viscous", "coulomb", "gravity", "offset"), ("viscous", "gravity", "offset")
    for terms in dict.fromkeys([proposed, *others]):
        for rate in (loop.sample_rate, *RATES):
            other = with_axis(loop, terms, rate)
            each = [ss.read(path, other) for path in files]
            whole, span = _gravity_over_inertia(other, each), ""
            if rate == loop.sample_rate:
                ratios = [_gravity_over_inertia(other, each[:k] + each[k + 1 :]) for k in range(len(each))]
                span = f"{min(ratios):.1f} to {max(ratios):.1f}"
                values.setdefault("ratio", f"{whole:.1f}")
            rows.append((", ".join(terms), f"{rate:.1f}", f"{whole:.1f}", span))
    ratio_note = f"All eight files under one fit, and without one of them. The authors' value is {AUTHORS}."
    ratio = Table(
        "XL330: gravity over inertia, 1/s²", ratio_note, ("terms", "Hz", "all files", "one file left out"), tuple(rows)
    )

    alarms: dict[str, list[tuple[bool, bool]]] = {}
    verdicts = []
    for k, run in enumerate(runs):
        others, changed = runs[:k] + runs[k + 1 :], with_gain(run, GAIN, CHANGED_S / run.duration_s)
        baseline = ss.learn(loop, others)
        said = [ss.diagnose(baseline, one) for one in (run, changed)]
        alarms.setdefault(OURS, []).append((said[0].verdict in FOUND, said[1].verdict in FOUND))
        named = ", ".join(fault.name for fault in said[1].faults) or said[1].verdict
        verdicts.append((run.name.removesuffix(".parquet"), said[0].verdict, named))
        for one in detectors(WINDOW_S, loop.cutoff):
            scores = judge(one, others, [run, changed])
            alarms.setdefault(one.name, []).append((scores.largest[0] > scores.limit, scores.largest[1] > scores.limit))
    counted = [
        (name, f"{sum(a for a, _ in each)} of {len(each)}", f"{sum(b for _, b in each)} of {len(each)}")
        for name, each in alarms.items()
    ]
    values |= {
        f"{name}.{what}": cell for name, *cells in counted for what, cell in zip(("false", "found"), cells, strict=True)
    }
    changed_note = f"u times {GAIN:g} from {CHANGED_S:g} s on; windows of {WINDOW_S:g} s."
    show(
        [
            ratio,
            Table("XL330: detectors", f"Each file judged by what the seven others taught. Changed: {changed_note}",
                  ("detector", "false", "found"), tuple(counted)),
            Table("XL330: verdicts of servoscope", "On each file as measured, and changed.",
                  ("file", "as measured", "changed"), tuple(verdicts)),
        ],
        given.json,
        values,
    )  # fmt: skip


def _gravity_over_inertia(loop: ss.Loop, runs: list[ss.Recording]) -> float:
    model, _ = fit_axis(loop, runs)
    return float("nan") if model is None else model.coefficients["gravity"] / model.coefficients["inertia"]
