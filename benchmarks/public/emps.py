"""EMPS, a measured positioning axis: the official score of the nonlinear benchmark, and servoscope as a detector.

    python benchmarks public/emps [--data DIR] [--json]

Official protocol (nonlinearbenchmark.org): identify on DATA_EMPS, simulate the position of DATA_EMPS_PULSES in open
loop from `vir`, root mean square error in mm from sample 20 on. What it leaves open, and what is done here: the
simulation starts at sample 20 from the measured position and the measured speed there (central difference over 2
samples); `vir` is held from one sample to the next; the axis sticks where the force does not overcome Coulomb friction
(`simulate_free`, the simulator of servoscope).
Other conventions stand beside it, with what 0.1 N of constant force does.

As a detector: each half of DATA_EMPS learned, the other judged, as measured and with changes; DATA_EMPS learned and the
recording with pulses judged, which is healthy under another motion.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from tables import Table, parse_with_data, parser, show

import servoscope as ss
from public.output_error import OutputErrorFit, fit_output_error, simulate_free
from public.servoscope_detector import COLUMNS, ROOT, Count, all_scores, with_coefficient, with_gain
from public.simple_detectors import halves
from servoscope.learning.axis_fit import fit_axis
from servoscope.models.plants.axis import AxisPlant

SKIPPED = 20  # samples before the score counts
WINDOW_S = 2.0
NAMES = ("inertia", "viscous_friction", "coulomb_friction", "offset")
AUTHORS = 95.1089, 203.5034, 20.3935, -3.1648  # Janot, Gautier and Brunot, 2019
OFFSET_N = 0.1
STARTS, START_SPREAD = 12, 0.1  # of the output error, which is not convex: their number, and the spread of coefficients
PUBLISHED = (("dynoNet, neural", "2.64", "Forgione and Piga, 2021, open-loop simulation of the test file"),)


def rmse_mm(
    loop: ss.Loop, plant: AxisPlant, recording: ss.Recording, start: str = "measured", hold: str = "held"
) -> float:
    """Return the root mean square error in mm of an open-loop simulation, from sample 20 on."""
    if hold != "held":
        recording = replace(recording, u=np.append(0.5 * (recording.u[1:] + recording.u[:-1]), recording.u[-1]))
    if start == "rest":
        simulated = simulate_free(loop, recording, plant, speed=0.0)[SKIPPED:]
    else:
        simulated = simulate_free(loop, recording, plant, start=SKIPPED, speed=0.0 if start == "no speed" else None)
    return 1e3 * float(np.sqrt(np.mean((simulated - recording.y[SKIPPED:]) ** 2)))


def axis_loop(loop: ss.Loop, viscous: str) -> ss.Loop:
    """Return the loop with a plant of kind ``axis`` and one of the terms of viscous friction."""
    plant = {"kind": "axis", "terms": [viscous, "coulomb", "offset"], "input_gain": loop.plant.input_gain}
    return ss.Loop.from_dict(loop.to_dict() | {"plant": plant})


def fitted_plant(loop: ss.Loop, recording: ss.Recording, plant: AxisPlant) -> AxisPlant:
    """Return the axis of least output error; the best of several starts, for the error is not convex."""
    fits = [fit_output_error(loop, [recording], one, drifts=False, start=SKIPPED) for one in started(plant)]
    best = min(fits, key=lambda fit: fit.rmse)
    found = best.plant.coefficients or {}
    return best.plant.model_copy(update={"coefficients": found | {"offset": found["offset"] + best.offset[0]}})


def started(plant: AxisPlant) -> list[AxisPlant]:
    """Return starts of a search: the plant itself, and others whose coefficients are drawn around its own."""
    rng, names = np.random.default_rng(0), ("inertia", "viscous_friction", "coulomb_friction")
    drawn = np.exp(START_SPREAD * rng.standard_normal((STARTS - 1, len(names))))
    return [plant, *(plant.scaled(dict(zip(names, row, strict=True))) for row in drawn.tolist())]


def scores(train: ss.Recording, test: ss.Recording, loop: ss.Loop) -> tuple[list[Table], dict[str, str]]:
    """Return the official score of three sets of parameters, conventions, and what a constant force does."""
    axis = axis_loop(loop, "viscous")
    assert isinstance(axis.plant, AxisPlant)
    baseline = ss.learn(loop, [train])
    authors, learned = (
        axis.plant.model_copy(update={"coefficients": dict(zip(NAMES, theta, strict=True))})
        for theta in (AUTHORS, [baseline.theta[baseline.names.index(name)] for name in NAMES])
    )
    sets = {
        "the authors' parameters": authors,
        "servoscope, coefficients of `learn`": learned,
        "the same four parameters by output error": fitted_plant(axis, train, authors),
    }
    rows, shifts, conventions = [], [], []
    values = {}
    for name, plant in sets.items():
        theta = plant.coefficients or {}
        each = [rmse_mm(axis, plant, one) for one in (train, test)]
        rows.append((name, *(f"{theta[key]:.2f}" for key in NAMES), *(f"{x:.2f}" for x in each), "measured here"))
        others = [
            plant.model_copy(update={"coefficients": theta | {"offset": theta["offset"] + force}})
            for force in (-OFFSET_N, OFFSET_N)
        ]
        moved = [rmse_mm(axis, other, test) for other in others]
        shifts.append((name, f"{moved[0]:.2f}", f"{each[1]:.2f}", f"{moved[1]:.2f}"))
        kept = [{}, {"start": "no speed"}, {"start": "rest"}, {"hold": "straight"}]
        conventions.append((name, *(f"{rmse_mm(axis, plant, test, **how):.2f}" for how in kept)))
        values[f"{name}.test"] = f"{each[1]:.2f}"
    rows += [(name, *[""] * 5, score, source) for name, score, source in PUBLISHED]
    heads = ("parameters", "M [kg]", "F_v [N s/m]", "F_c [N]", "offset [N]", "DATA_EMPS [mm]", "test [mm]", "source")
    return [
        Table(
            "EMPS: official score",
            "Identified on DATA_EMPS, open-loop simulation from `vir`, root mean square error in mm from sample 20 on.",
            heads,
            tuple(rows),
        ),
        Table(
            "EMPS: a tenth of a newton",
            f"The score on the test file when the offset is {OFFSET_N:g} N smaller, as identified, and {OFFSET_N:g} N "
            "larger: the ranking is one of constant forces, and these differ from recording to recording.",
            ("parameters", f"-{OFFSET_N:g} N [mm]", "as identified [mm]", f"+{OFFSET_N:g} N [mm]"),
            tuple(shifts),
        ),
        Table(
            "EMPS: conventions",
            "The score on the test file under conventions that the protocol leaves open.",
            (
                "parameters",
                "as above [mm]",
                "start without speed [mm]",
                "start at sample 0, at rest [mm]",
                "`vir` straight between samples [mm]",
            ),
            tuple(conventions),
        ),
    ], values


def by_direction(train: ss.Recording, test: ss.Recording, loop: ss.Loop) -> tuple[Table, dict[str, str]]:
    """Return what friction by direction scores by output error: as the protocol has it, and with own forces."""
    axis = axis_loop(loop, "viscous_by_direction")
    model, _ = fit_axis(axis, [train])
    assert model is not None and isinstance(axis.plant, AxisPlant)
    learned = model.plant(axis.plant)
    starts = started(learned)

    def fits(one: ss.Recording, drifts: bool) -> list[OutputErrorFit]:
        found = [fit_output_error(axis, [one], start, drifts=drifts, start=SKIPPED) for start in starts]
        return sorted(found, key=lambda fit: fit.rmse)  # the score of the test file has no part in the choice

    def score(fit: OutputErrorFit) -> float:
        error = simulate_free(axis, test, fit.plant, start=SKIPPED, offset=fit.offset[0]) - test.y[SKIPPED:]
        return 1e3 * float(np.sqrt(np.mean(error**2)))

    trained = fits(train, False)
    plain, own = trained[0], {one.name: fits(one, True)[0] for one in (train, test)}
    official, every_score = score(plain), [score(fit) for fit in trained]
    spans = [f"{min(x):.2f} to {max(x):.2f}" for x in ([1e3 * fit.rmse[0] for fit in trained], every_score)]
    force = fit_output_error(axis, [test], plain.plant, free=(), drifts=False, start=SKIPPED)
    rows = [
        ("identified on DATA_EMPS, test file simulated: official", plain, official),
        ("the same, the constant force of the test file estimated on it", plain, 1e3 * force.rmse[0]),
        *((f"all fitted on {name}, its force with a drift", fit, 1e3 * fit.rmse[0]) for name, fit in own.items()),
    ]
    coefficients = ("inertia", "viscous_friction_forward", "viscous_friction_backward", "coulomb_friction")
    cells = tuple(
        (name, *(f"{(fit.plant.coefficients or {})[key]:.2f}" for key in coefficients), f"{score:.2f}")
        for name, fit, score in rows
    )
    heads = ("what", "M [kg]", "F_v forward [N s/m]", "F_v backward [N s/m]", "F_c [N]", "rmse [mm]")
    note = (
        "`fit_output_error` and `simulate_free`, viscous friction by direction, from sample 20 on. The best of "
        f"{STARTS} starts, by its error on DATA_EMPS; over all starts {spans[0]} mm there and {spans[1]} mm on the "
        "test file."
    )
    values = {"by direction.test": f"{official:.2f}", "by direction.training range": spans[0]}
    return Table("EMPS: friction by direction", note, heads, cells), values | {"by direction.test range": spans[1]}


def detection(train: ss.Recording, test: ss.Recording, loop: ss.Loop) -> tuple[Table, dict[str, str]]:
    """Return what servoscope and the simple detectors make of halves, changes and the other motion."""
    changes: dict[str, Callable[[ss.Recording], ss.Recording]] = {
        "inertia x 1.3": lambda one: with_coefficient(one, loop, 0.3 * AUTHORS[0], 2),
        "viscous friction x 1.3": lambda one: with_coefficient(one, loop, 0.3 * AUTHORS[1], 1),
        "gain x 1.1": lambda one: with_gain(one, 1.1),
    }
    counts: dict[str, Count] = {}
    of_change: dict[str, list[int]] = {}
    parts = halves(train)
    for one, other in (parts, parts[::-1]):
        judged = [other, *(change(other) for change in changes.values())]
        for name, found in all_scores(loop, [one], judged, WINDOW_S).items():
            counts.setdefault(name, Count()).add(found, 1)
            told = of_change.setdefault(name, [0] * len(changes))
            for i, score in enumerate(found.largest[1:]):
                told[i] += score > found.limit
    other_motion = {
        name: found.largest[0] / found.limit for name, found in all_scores(loop, [train], [test], WINDOW_S).items()
    }
    rows = tuple(
        (name, *count.cells, *(f"{n} of 2" for n in of_change[name]), f"{other_motion[name]:.2f}")
        for name, count in counts.items()
    )
    note = (
        "Each half of DATA_EMPS learned, the other judged. Last: DATA_EMPS learned, the recording with pulses judged."
    )
    heads = (*COLUMNS, *changes, "other motion, score / limit")
    return Table("EMPS: detectors", note, heads, rows), {f"{row[0]}.found": row[2] for row in rows}


def main() -> None:
    """Run the command line of this process."""
    given = parse_with_data(parser(__doc__), "real/emps")
    folder = given.data / "real" / "emps"
    loop = ss.Loop.load(ROOT / "examples" / "emps.toml")
    train, test = (ss.read(folder / f"{name}.mat", loop) for name in ("DATA_EMPS", "DATA_EMPS_PULSES"))
    tables, values = scores(train, test, loop)
    directions, score = by_direction(train, test, loop)
    table, found = detection(train, test, loop)
    show([*tables, directions, table], given.json, values | score | found)
