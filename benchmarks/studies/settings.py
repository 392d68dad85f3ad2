"""What the settings of `[monitor]` and `[plant]` cost and buy on recorded loops; prints Markdown tables.

    python benchmarks studies/settings [--data DIR] [--json]

The loop files are those of `examples/` and the reference rig inside the package, with one setting changed at a time.
Every baseline is learned from recordings that are not judged with it.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from studies.machines import LOADS, Machines
from studies.recordings import Judged, change_u
from tables import Table, parse_with_data, parser, show

import servoscope as ss

BALL_SCREW_NOTE = (
    "Learned from runs 1 to 5 at each of three loads; runs 6 to 10 are judged, and ten without lubrication."
)
BALL_SCREW = ("false alarms", "lack of lubrication at 40 kgf")
CUTOFFS = (2.0, 5.0, 10.0, 20.0, 50.0, 100.0)  # Hz
MEMORIES = (1.0, 2.0, 5.0, 10.0)  # s
MODEL_ERRORS = (0.0, 0.005, 0.01, 0.02)
BUDGETS = (0.01, 1.0, 12.0, 365.0)  # a year
LEAK_AT = 30.0  # s
EVALUATION_RATES = (1.0, 10.0, 100.0)  # Hz


def seen_from(baseline: ss.Baseline, name: str) -> str:
    """Return the smallest change that a baseline promises to see."""
    change = next(promise.change for promise in baseline.detectability.changes if promise.name == name)
    return "never" if change is None else percent(change)


def percent(share: float) -> str:
    """Return a share as text, with as many digits as it deserves."""
    return f"{100.0 * share:.1f} %" if share < 0.3 else f"{100.0 * share:.0f} %"


def changed(loop: ss.Loop, plant: dict[str, Any] | None = None, **monitor: Any) -> ss.Loop:
    """Return a loop with other settings."""
    settings = loop.to_dict()
    return ss.Loop.from_dict(
        {**settings, "plant": settings["plant"] | (plant or {}), "monitor": settings["monitor"] | monitor}
    )


def delay_text(judged: Judged, at_s: float) -> str:
    """Return how long after a change it was found."""
    found = judged.diagnosis.detected_at_s
    if found is None:
        return "not found"
    late = found - at_s
    return f"after {late:.2g} s" if late >= 0.0 else f"false alarm {-late:.0f} s before it"


def margin(judged: Judged) -> str:
    """Return the largest statistic as a multiple of its threshold."""
    ratio = judged.statistic / judged.threshold
    return f"{ratio:.2f}" if ratio < 1.0 else f"{ratio:.1f}"


def heavier(m: Machines, loop: ss.Loop) -> tuple[ss.Baseline, Judged, str]:
    """Learn one half of EMPS; return the baseline, the other half judged, and when 30 % of inertia are found."""
    first, second = m.emps_halves
    baseline = ss.learn(loop, [first])
    suspect, at = change_u(second, baseline, "inertia")
    return baseline, Judged.of(baseline, second), delay_text(Judged.of(baseline, suspect), at)


def leaking(m: Machines, loop: ss.Loop) -> tuple[ss.Baseline, Judged, str]:
    """Learn the healthy rig; return the baseline, the recording with 20 % of leakage judged, and its delay."""
    healthy, suspect = m.rig
    baseline = ss.learn(loop, [healthy])
    judged = Judged.of(baseline, suspect)
    return baseline, judged, delay_text(judged, LEAK_AT)


def cutoff(m: Machines) -> Iterator[Table]:
    """Vary the cutoff."""
    rows = []
    for hz in CUTOFFS:
        baseline = ss.learn(changed(m.loops["emps"], cutoff=hz), [m.emps])
        theta = dict(zip(baseline.names, baseline.theta, strict=True))
        coefficients = (f"{theta[name]:.2f}" for name in ("inertia", "viscous_friction", "coulomb_friction"))
        cells = (*coefficients, f"{100.0 * baseline.detectability.explained:.2f} %", seen_from(baseline, "inertia"))
        rows.append((f"{hz:g} Hz", *cells))
    yield Table(
        "Cutoff",
        "EMPS, whole recording.",
        ("cutoff", "inertia", "viscous friction", "Coulomb friction", "explained", "inertia seen from"),
        tuple(rows),
    )
    rows = []
    for hz in (0.5, 1.0, 2.0):
        rows.append((f"{hz:g} Hz", *m.ball_screw(changed(m.loops["cranfield"], cutoff=hz), LOADS)))
    yield Table("Cutoff: Cranfield", BALL_SCREW_NOTE, ("cutoff", *BALL_SCREW), tuple(rows))


def memory(m: Machines) -> Iterator[Table]:
    """Vary the memory."""
    rows = []
    for seconds in MEMORIES:
        baseline, judged, late = leaking(m, changed(m.loops["rig"], memory=seconds))
        size = next((c.faults[0] for c in judged.diagnosis.candidates if c.name == "leakage"), None)
        told = "" if size is None else f"{size.ratio:.3f} ({size.interval[0]:.3f} to {size.interval[1]:.3f})"
        rows.append((f"{seconds:g} s", seen_from(baseline, "leakage"), late, told))
    yield Table(
        "Memory",
        "Reference rig, multisine, leakage +20 %. The size is that of the best explanation, from the refit.",
        ("memory", "leakage seen from", "detected after", "size (95 % interval)"),
        tuple(rows),
    )
    rows = []
    for seconds in (1.0, 2.0, 5.0, 20.0):
        baseline, _, late = heavier(m, changed(m.loops["emps"], memory=seconds))
        rows.append((f"{seconds:g} s", seen_from(baseline, "inertia"), late))
    yield Table(
        "Memory: EMPS",
        "Learned from one half of 12.4 s; inertia +30 % in the other.",
        ("memory", "inertia seen from", "inertia +30 %"),
        tuple(rows),
    )
    rows = []
    for seconds in (5.0, 10.0, 20.0):
        loop = changed(m.loops["cranfield"], memory=seconds)
        rows.append((f"{seconds:g} s", *m.ball_screw(loop, LOADS)))
    yield Table("Memory: Cranfield", BALL_SCREW_NOTE, ("memory", *BALL_SCREW), tuple(rows))


def model_error(m: Machines) -> Iterator[Table]:
    """Vary the model error."""
    rows = []
    for share in MODEL_ERRORS:
        baseline, healthy, late = heavier(m, changed(m.loops["emps"], model_error=share))
        rows.append((f"{share:g}", seen_from(baseline, "inertia"), margin(healthy), late))
    residual = ss.inspect(m.emps, m.loops["emps"]).residual
    most = "nothing" if residual is None else f"{residual.model_error:.1g}"
    yield Table(
        "Model error",
        "EMPS, learned from one half, the other judged. "
        f"For the whole recording `inspect` names {most} as the most that could be needed.",
        ("model_error", "inertia seen from", "largest healthy T^2 / threshold", "inertia +30 %"),
        tuple(rows),
    )
    rows = []
    for share in (0.0, 0.01, 0.02, 0.05):
        rig = ss.learn(changed(m.loops["rig"], model_error=share), [m.rig[0]])
        loop = changed(m.loops["qube"], model_error=share)
        pairs = [(i, j) for i in range(3) for j in range(3) if i != j]
        judged = [Judged.of(ss.learn(loop, [m.qube[j]]), m.qube[i]) for i, j in pairs]
        false = sum(one.diagnosis.verdict in ("suspect", "fault") for one in judged)
        pump = ss.learn(changed(m.loops["eha-pump"], model_error=share), [m.pump(1, 4)])
        rows.append(
            (
                f"{share:g}",
                seen_from(rig, "leakage"),
                f"{false} of {len(pairs)}, worst {max(map(margin, judged))}",
                seen_from(ss.learn(loop, m.qube), "inertia"),
                margin(Judged.of(pump, m.pump(3, 2))),
            )
        )
    yield Table(
        "Model error: other machines",
        "Reference rig; QUBE, each of three healthy runs judged by each other one (false alarms, largest "
        "T^2 / threshold), and its promise from all three; pump-controlled EHA, load 3 with the short stroke "
        "against load 1 (largest T^2 / threshold).",
        ("model_error", "rig: leakage seen from", "QUBE: healthy pairs", "QUBE: inertia seen from", "pump: load 3"),
        tuple(rows),
    )


def update_when(m: Machines) -> Iterator[Table]:
    """Let the estimator listen at rest, or not."""
    rows = []
    for label, settings in (
        ('`"moving"`, rest_speed = 1e-3', {}),
        ('`"always"`', {"update_when": "always"}),
    ):
        baseline = ss.learn(changed(m.loops["eha-pump"], **settings), [m.pump(1, 4)])
        judged = (margin(Judged.of(baseline, m.pump(load, stroke))) for load, stroke in ((3, 2), (5, 4)))
        rows.append(
            (
                label,
                f"{100.0 * baseline.detectability.explained:.2f} %",
                seen_from(baseline, "viscous_friction"),
                *judged,
            ),
        )
    yield Table(
        "update_when",
        "Pump-controlled EHA, learned from load 1, stroke 4. Other loads: largest T^2 / threshold.",
        ("update_when", "explained", "viscous friction seen from", "load 3, stroke 2", "load 5, stroke 4"),
        tuple(rows),
    )


def friction(m: Machines) -> Iterator[Table]:
    """Vary how friction is modelled on the ball screw."""
    rows = []
    for model in ("coulomb", "directional"):
        for source in ("output", "reference"):
            loop = changed(m.loops["cranfield"], {"friction": model, "sign_from": source})
            learned = [ss.learn(loop, m.cranfield("normal", load, "1-5")).detectability.explained for load in LOADS]
            explained = f"{100.0 * min(learned):.0f} to {100.0 * max(learned):.0f} %"
            rows.append((f'`"{model}"`', f'`"{source}"`', explained, *m.ball_screw(loop)))
    yield Table(
        "Friction",
        "Cranfield, learned from runs 1 to 5; three loads explained, alarms at 40 kgf.",
        ("friction", "sign_from", "explained", "false alarms", "lack of lubrication"),
        tuple(rows),
    )


def statistic(m: Machines) -> Iterator[Table]:
    """Vary how often and how strictly the statistic is looked at."""
    rows = []
    for rate in EVALUATION_RATES:
        baseline, _, late = leaking(m, changed(m.loops["rig"], evaluation_rate=rate))
        rows.append((f"{rate:g} Hz", f"{baseline.thresholds.statistic:.1f}", late))
    yield Table(
        "evaluation_rate",
        "Reference rig, multisine, leakage +20 %.",
        ("evaluation_rate", "threshold", "detected after"),
        tuple(rows),
    )
    rows = []
    for budget in BUDGETS:
        baseline = ss.learn(changed(m.loops["rig"], false_alarms_per_year=budget), [m.rig[0]])
        rows.append((f"{budget:g}", f"{baseline.thresholds.statistic:.1f}", seen_from(baseline, "leakage")))
    yield Table(
        "false_alarms_per_year",
        "Reference rig, multisine.",
        ("budget per year", "threshold", "leakage seen from"),
        tuple(rows),
    )


def structure(m: Machines) -> Iterator[Table]:
    """Vary the regression and the estimator."""
    rows = []
    for kind, estimator in (("svf", "akf"), ("svf", "iv-akf"), ("tustin", "akf"), ("tustin-held", "akf")):
        baseline, _, late = leaking(m, changed(m.loops["rig"], structure=kind, estimator=estimator))
        rows.append((f'`"{kind}"`', f'`"{estimator}"`', seen_from(baseline, "leakage"), late))
    yield Table(
        "Structure",
        "Reference rig, multisine, leakage +20 %.",
        ("structure", "estimator", "leakage seen from", "detected after"),
        tuple(rows),
    )


def main() -> None:
    """Run the command line of this process."""
    given = parse_with_data(parser(__doc__), "eha_cases")
    machines = Machines(given.data)
    sections = (cutoff, memory, model_error, update_when, friction, statistic, structure)
    tables = [table for section in sections for table in section(machines)]
    show(tables, given.json)
