"""Why: what moved and by how much, what the named fault leaves unexplained, and what speaks against the others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servoscope.diagnosis import UNKNOWN, Candidate, Refit, Trace
from servoscope.errors import LoopError
from servoscope.examination import Examination
from servoscope.inverse import nominal_theta
from servoscope.plants import FloatArray

MOVED = 3.0  # standard deviations from which a value has moved
MOST = 3  # values and rejected candidates that are told
REJECTED = 0.01  # probability below which a candidate is rejected


def reasons(
    x: Examination, trace: Trace, at: int, candidates: Sequence[Candidate], refit: Refit | None
) -> tuple[str, ...]:
    """Return the explanation of an alarm, sentence by sentence.

    Parameters
    ----------
    x, trace
        The examination, and its estimates without bias.
    at
        Evaluation that is explained.
    candidates, refit
        Of the diagnosis.
    """
    told = [_raised(x), _coefficients(trace, at), _frequencies(trace, at), _left(candidates, refit)]
    told += [_against(x, trace, at, c) for c in _rejected(candidates)]
    return tuple(sentence for sentence in (*told, _second(candidates), _mimics(refit)) if sentence)


def _raised(x: Examination) -> str:
    first = int(np.flatnonzero(x.alarm)[0])
    statistic, level = float(x.statistic[first]), float(x.estimates.level[first])
    if level >= 1.0:
        return f"The sequential test passed its limit at {x.t[first]:.1f} s ({level:.3g} times the limit)."
    return f"T² passed its limit at {x.t[first]:.1f} s ({statistic:.3g}, limit {x.baseline.limit:.3g})."


def _moved(what: str, value: float, expected: float, std: float) -> tuple[float, str]:
    by = abs(value - expected) / std if std > 0.0 else 0.0
    way = "rose" if value > expected else "fell"
    return by, f"{what} {way} from {expected:.4g} to {value:.4g} ({by:.3g} standard deviations)"


def _listed(found: Sequence[tuple[float, str]]) -> str:
    return "; ".join([words for by, words in sorted(found, reverse=True)[:MOST] if by >= MOVED])


def _coefficients(trace: Trace, at: int) -> str:
    std = np.sqrt(np.diag(trace.covariance[at]))
    values = zip(trace.names, trace.theta[at], trace.expected[at], std, strict=True)
    told = _listed([_moved(name, float(v), float(e), float(s)) for name, v, e, s in values])
    return f"At {trace.t[at]:.1f} s {told or 'no coefficient alone is far from healthy'}."


def _frequencies(trace: Trace, at: int) -> str:
    found = []
    for i, f in enumerate(trace.ifrf.frequencies):
        now, healthy = trace.ifrf.H[at, i], trace.ifrf_expected.H[at, i]
        real, imag = np.sqrt(np.diag(trace.ifrf.covariance[at, i])).tolist()
        found.append(_moved(f"the real part at {f:g} Hz", float(now.real), float(healthy.real), real))
        found.append(_moved(f"the imaginary part at {f:g} Hz", float(now.imag), float(healthy.imag), imag))
    told = _listed(found)
    return f"Of the inverse frequency response {told}." if told else ""


def _left(candidates: Sequence[Candidate], refit: Refit | None) -> str:
    best = next((c for c in candidates if c.faults), None)
    if refit is None or best is None:
        return ""
    return (
        f"From {refit.from_s:.1f} to {refit.to_s:.1f} s {best.name} at its best leaves {refit.misfit:.3g} unexplained; "
        f"what is true leaves at most {refit.limit:.3g}."
    )


def _rejected(candidates: Sequence[Candidate]) -> list[Candidate]:
    singles = [c for c in candidates[1:] if len(c.faults) == 1 and c.probability < REJECTED]
    return sorted(singles, key=lambda c: c.misfit or 0.0)[:MOST]


def _against(x: Examination, trace: Trace, at: int, other: Candidate) -> str:
    """Say why a candidate was rejected, and where it shows."""
    (fault,) = other.faults
    further = np.sqrt(other.misfit or 0.0)
    words = (
        f"{other.name} ({fault.parameter} x {fault.ratio:.3g} at best) is {further:.3g} standard deviations further off"
    )
    theta = _theta_of(x, other)
    if theta is not None:
        off = (theta - trace.theta[at]) / np.sqrt(np.diag(trace.covariance[at]))
        worst = int(np.argmax(np.abs(off)))
        if abs(off[worst]) >= MOVED:
            words += f": {trace.names[worst]} would be {'higher' if off[worst] > 0.0 else 'lower'} than it is"
    return f"{words}."


def _second(candidates: Sequence[Candidate]) -> str:
    best = candidates[0]
    pairs = [
        c for c in candidates[1:] if len(c.faults) > 1 and {f.name for f in best.faults} < {f.name for f in c.faults}
    ]
    if not pairs or candidates[0].name == UNKNOWN:
        return ""
    others = sorted({fault.name for pair in pairs for fault in pair.faults} - {fault.name for fault in best.faults})
    return (
        f"A second fault beside {best.name} ({' or '.join(others)}) would explain too little to be worth its freedom."
    )


def _theta_of(x: Examination, candidate: Candidate) -> FloatArray | None:
    if not x.baseline.loop.plant.has_physics or candidate.is_learned:
        return None
    ratios = {fault.parameter: fault.ratio for fault in candidate.faults}
    try:
        return nominal_theta(x.pipeline.loop, x.baseline.plant.with_ratios(ratios))
    except LoopError:
        return None


def _mimics(refit: Refit | None) -> str:
    if refit is None or not refit.mimics:
        return ""
    told = [
        f"{m.words} (x {m.value:.3g})" if m.unit == "ratio" else f"{m.words} ({m.value:.3g} {m.unit})"
        for m in refit.mimics
    ]
    return f"The same recording would come from {' or '.join(told)}."
