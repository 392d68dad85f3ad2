"""The signatures of one recording's possible faults: simulated with its loop, from physics alone, or by coefficient."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from servoscope.baseline import Baseline
from servoscope.identification import fault_directions
from servoscope.inverse import nominal_theta
from servoscope.isolation import Signature, curve, line
from servoscope.plants import Fault, FloatArray
from servoscope.recording import Recording
from servoscope.signatures import Expectation

Shift = Callable[[float], FloatArray]

MOST_KEPT = 10_000  # points of signatures, of this process
_kept: dict[tuple[object, ...], FloatArray] = {}


def candidates_of(
    baseline: Baseline,
    recording: Recording,
    expectation: Expectation | None,
    since: int,
    settled: bool = False,
) -> list[Signature]:
    """Return one signature per fault of the loop's plant, and one per fault learned from labelled recordings.

    Parameters
    ----------
    baseline
        What is compared with what.
    recording
        What the evaluation that is explained still remembers; it ends there.
    expectation
        Of the same; None where the loop cannot be simulated.
    since
        Sample of the onset in it; 0: then or before.
    settled
        Whether the estimate to be explained has taken up all of a change: no recursion, or one that has forgotten.
    """
    needed = not settled and (expectation is None or bool(baseline.learned))
    taken_up = _learned(baseline, recording, since) if needed else np.eye(len(baseline.theta))
    known = _of_plant(baseline, expectation, since, taken_up)
    return known + [fault.signature(taken_up) for fault in baseline.learned]


def _of_plant(baseline: Baseline, expectation: Expectation | None, since: int, learned: FloatArray) -> list[Signature]:
    faults, plant = baseline.loop.plant.faults, baseline.plant
    if expectation is not None:
        shift = _simulated(baseline, expectation, since)
        return [curve(fault, shift(fault), baseline.ratios_std.get(fault.parameter, 0.0)) for fault in faults]
    if plant.has_physics and plant.kind != "polynomial":
        shift = _physical(baseline, learned)
        return [curve(fault, shift(fault)) for fault in faults]
    directions = fault_directions(baseline.loop, plant, np.array(baseline.theta))
    moving = [fault for fault in faults if np.any(directions[fault.parameter])]
    return [line(fault, learned @ directions[fault.parameter]) for fault in moving]


def _simulated(baseline: Baseline, expectation: Expectation, since: int) -> Callable[[Fault], Shift]:
    """Let the fault step in at the onset, and ask what the recursion would say at the end; the answers are kept."""
    plant, start = baseline.plant, np.array(baseline.model_theta)
    healthy = expectation.path(start, plant)[-1]
    common = (expectation.hash, plant.model_dump_json(), start.tobytes(), since)

    def of(fault: Fault) -> Shift:
        def shift(ratio: float) -> FloatArray:
            key = (*common, fault.parameter, ratio)
            if key not in _kept:
                ill = plant.with_ratios({fault.parameter: ratio})
                moved: FloatArray = expectation.path(start, plant, ill, since)[-1] - healthy
                if len(_kept) >= MOST_KEPT:
                    _kept.clear()
                _kept[key] = moved
            return _kept[key]

        return shift

    return of


def _physical(baseline: Baseline, learned: FloatArray) -> Callable[[Fault], Shift]:
    """Take the coefficients of the changed plant, as far as the recursion has taken them up."""
    loop, plant = baseline.loop, baseline.plant
    healthy = nominal_theta(loop, plant)

    def of(fault: Fault) -> Shift:
        def shift(ratio: float) -> FloatArray:
            ill = plant.with_ratios({fault.parameter: ratio})
            return np.asarray(learned @ (nominal_theta(loop, ill) - healthy))

        return shift

    return of


def _learned(baseline: Baseline, recording: Recording, since: int) -> FloatArray:
    """Return I - Psi from the onset to the end: the share of a change that theta_hat has taken up by then."""
    Psi = baseline.pipeline().estimate(baseline.tuning, recording.rows(slice(since, None))).Psi
    n = len(baseline.theta)
    return np.eye(n) - Psi[-1] if len(Psi) else np.eye(n)
