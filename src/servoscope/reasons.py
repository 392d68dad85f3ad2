"""Why: what moved and by how much, what the named fault leaves unexplained, and what speaks against the others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servoscope.diagnosis import UNKNOWN, Candidate, Refit, Trace
from servoscope.digits import short
from servoscope.errors import LoopError
from servoscope.examination import Examination
from servoscope.inverse import nominal_theta
from servoscope.plants import FloatArray

MOVED = 3.0  # standard deviations from which a value has moved
DEVIATIONS = " standard deviations"
MOST = 3  # values and rejected candidates that are told
REJECTED = 0.01  # probability below which a candidate is rejected
LIKELY = 0.05  # probability below which a second fault is not worth its freedom


def reasons(
    x: Examination, trace: Trace, detected_at: float, candidates: Sequence[Candidate], refit: Refit | None
) -> tuple[str, ...]:
    """Return the explanation of an alarm, sentence by sentence.

    Parameters
    ----------
    x
        The examination.
    trace
        The evaluation that is explained, without bias.
    detected_at, candidates, refit
        Of the diagnosis.
    """
    told = (
        _raised(x, detected_at),
        _coefficients(x, trace),
        _frequencies(x, trace),
        _left(candidates, refit),
        _rejected(x, trace, candidates),
        _second(candidates),
        _mimics(candidates, refit),
    )
    return tuple(sentence for sentence in told if sentence)


def _raised(x: Examination, detected_at: float) -> str:
    first = int(np.flatnonzero(x.alarm)[0])
    if x.estimates.level[first] >= 1.0:
        return f"The sequential test passed its limit at {detected_at:.2f} s."
    reached, limit = short(float(x.statistic[first])), short(x.baseline.limit)
    return f"T² passed its limit at {detected_at:.2f} s: {reached}, limit {limit}."


def _moved(what: str, value: float, expected: float, std: float, unit: str = "") -> tuple[float, str]:
    by = abs(value - expected) / std if std > 0.0 else 0.0
    way = "risen" if value > expected else "fallen"
    return by, f"{what} has {way} from {expected:.4g} to {value:.4g}{unit and ' '}{unit} ({short(by)}{DEVIATIONS})"


def _listed(found: Sequence[tuple[float, str]]) -> str:
    """Join what moved most, with the unit spelled out once."""
    return _joined([words for by, words in sorted(found, reverse=True)[:MOST] if by >= MOVED])


def _joined(told: Sequence[str]) -> str:
    return "; ".join([*told[:1], *(words.replace(DEVIATIONS, "") for words in told[1:])])


def _coefficients(x: Examination, trace: Trace) -> str:
    std, plant = np.sqrt(np.diag(trace.covariance[0])), x.baseline.plant
    units = plant.coefficient_units if plant.units[1] else ("",) * len(std)
    values = zip(trace.names, trace.theta[0], trace.expected[0], std, units, strict=True)
    told = _listed([_moved(name, float(v), float(e), float(s), unit) for name, v, e, s, unit in values])
    return f"By {trace.t[0]:.1f} s {told or 'no coefficient alone has left its healthy range'}."


def _frequencies(x: Examination, trace: Trace) -> str:
    of_y, of_u = x.baseline.plant.units
    unit = f"{of_u}/{of_y}" if of_u else ""
    found = []
    for i, f in enumerate(trace.ifrf.frequencies):
        now, healthy = trace.ifrf.H[0, i], trace.ifrf_expected.H[0, i]
        real, imag = np.sqrt(np.diag(trace.ifrf.covariance[0, i])).tolist()
        found.append(_moved(f"real part at {f:g} Hz", float(now.real), float(healthy.real), real, unit))
        found.append(_moved(f"imaginary part at {f:g} Hz", float(now.imag), float(healthy.imag), imag, unit))
    told = _listed(found)
    return f"Inverse frequency response: {told}." if told else ""


def _left(candidates: Sequence[Candidate], refit: Refit | None) -> str:
    """Say how well the closest explanation fits."""
    best = next((c for c in candidates if c.faults), None)
    if refit is None or best is None:
        return ""
    over = f"From {refit.from_s:.1f} to {refit.to_s:.1f} s"
    numbers = f"misfit {short(refit.misfit)}, limit {short(refit.limit)}"
    if refit.misfit > refit.limit:
        return f"{over} even the closest of all faults and pairs leaves more unexplained than noise would: {numbers}."
    return f"{over} {best.name} leaves no more unexplained than noise would: {numbers}."


def _rejected(x: Examination, trace: Trace, candidates: Sequence[Candidate]) -> str:
    singles = [c for c in candidates[1:] if len(c.faults) == 1 and c.probability < REJECTED]
    closest = sorted(singles, key=lambda c: c.misfit or 0.0)[:MOST]
    return f"Rejected: {_joined([_against(x, trace, c) for c in closest])}." if closest else ""


def _against(x: Examination, trace: Trace, other: Candidate) -> str:
    """Say by how much a candidate fits worse, and where it shows."""
    (fault,) = other.faults
    further = float(np.sqrt(other.misfit or 0.0))
    size = "labelled severity" if fault.learned else fault.parameter
    what = "" if fault.parameter == fault.name else f"{size} "
    fit = f"fits {short(further)}{DEVIATIONS} worse" if further else "is the closest but does not fit"
    words = f"{other.name} ({what}x {fault.ratio:.3g} at best) {fit}"
    theta = _theta_of(x, other)
    if theta is not None:
        off = (theta - trace.theta[0]) / np.sqrt(np.diag(trace.covariance[0]))
        worst = int(np.argmax(np.abs(off)))
        if abs(off[worst]) >= MOVED:
            words += f" with {trace.names[worst]} too {'high' if off[worst] > 0.0 else 'low'}"
    return words


def _second(candidates: Sequence[Candidate]) -> str:
    best = candidates[0]
    named = {fault.name for fault in best.faults}
    pairs = [c for c in candidates[1:] if len(c.faults) > 1 and named < {fault.name for fault in c.faults}]
    if not pairs or best.name == UNKNOWN or max(c.probability for c in pairs) >= LIKELY:
        return ""
    others = sorted({fault.name for pair in pairs for fault in pair.faults} - named)
    return f"A second fault beside {best.name} ({' or '.join(others)}) explains too little to be worth its freedom."


def _mimics(candidates: Sequence[Candidate], refit: Refit | None) -> str:
    if refit is None or not refit.mimics:
        return ""
    told = " or ".join(f"{mimic.words} ({mimic.size})" for mimic in refit.mimics)
    if candidates[0].name == UNKNOWN:
        return f"Outside the list of faults this would explain it: {told}."
    return f"The same recording would come from {told}."


def _theta_of(x: Examination, candidate: Candidate) -> FloatArray | None:
    if not x.baseline.loop.plant.has_physics or candidate.is_learned:
        return None
    ratios = {fault.parameter: fault.ratio for fault in candidate.faults}
    try:
        return nominal_theta(x.pipeline.loop, x.baseline.plant.with_ratios(ratios))
    except LoopError:
        return None
