"""What an examination cannot tell: changes too small for this recording, and doubts about the estimate itself."""

from __future__ import annotations

import numpy as np

from servoscope import spool
from servoscope.detection import noncentrality, required_noncentrality
from servoscope.diagnosis import Warning
from servoscope.examination import MOST_REFUSED, Examination
from servoscope.identification import MOST_SATURATED, fault_directions, saturated

AT_ONCE = 4096  # evaluations
WORTH_TELLING = 0.01  # share of updates without an instrument that is warned about
NO_PROMISE = 10.0  # relative change; who sees nothing smaller sees nothing
WEAKER = 3.0  # a recording that sees only changes this much larger than promised is called undetermined


def seen_by(x: Examination) -> dict[str, tuple[float, float]]:
    """Return, by parameter, the smallest change that would have shown here, and what the baseline promises."""
    promised = {p.parameter: p.change for p in x.baseline.promises if p.change is not None and p.change < NO_PROMISE}
    directions = fault_directions(x.baseline.loop, x.baseline.plant, x.tuning.theta)
    rows = np.array([directions[parameter] for parameter in promised])
    best, e = np.zeros(len(rows)), x.estimates
    for at in spool.pieces(0, x.evaluations, e.S, e.Psi, at_once=AT_ONCE) if len(rows) else ():
        ok = e.updates[at] > 0
        if ok.any():
            best = np.maximum(best, noncentrality(x.covariance(at)[ok], e.Psi[at][ok], rows).max(axis=0))
    needed = required_noncentrality(x.pipeline.bank.n, x.baseline.limit)
    smallest = (float(np.sqrt(needed / one)) if one > 0.0 else np.inf for one in best)
    return dict(zip(promised, zip(smallest, promised.values(), strict=True), strict=True))


def blind_to(x: Examination, seen: dict[str, tuple[float, float]]) -> list[str]:
    """Return what this recording could not have shown although the baseline promises it."""
    if (share := saturated(x.baseline.loop, x.recording)) > MOST_SATURATED:
        return [f"u is at a limit in {share:.0%} of the rows: nothing would have shown"]
    if not seen:
        return ["the baseline promises to see no change at all: learn it from recordings with more motion"]
    if all(np.isinf(smallest) for smallest, _ in seen.values()):
        return ["too short or too little motion: no change of any size would have shown"]
    return [
        f"too short or too little motion: a change of {parameter} would show "
        f"{'not at all' if np.isinf(smallest) else f'only from {smallest:.0%} on'}, promised is {promise:.0%}"
        for parameter, (smallest, promise) in seen.items()
        if smallest > WEAKER * promise
    ]


def doubts(x: Examination) -> list[Warning]:
    """Return warnings about the estimate itself."""
    told = []
    e, t = x.estimates, x.recording.t
    if x.refused > WORTH_TELLING:
        instead = ", so estimator = 'akf' was used instead" if x.refused > MOST_REFUSED else ""
        message = f"the instrument was too weak for {x.refused:.0%} of the updates{instead}"
        span = float(t[0]), float(t[-1])
        told.append(Warning(kind="instrument", from_s=span[0], to_s=span[1], count=1, message=message))
    if x.growth > 1.0:
        message = (
            f"{np.sqrt(x.growth):.2g} times the baseline's noise: look at the sensor and its cable; the healthy "
            "expectation was computed with it"
        )
        told.append(Warning(kind="noise", from_s=float(t[0]), to_s=float(t[-1]), count=1, message=message))
    if len(e.updates) and e.updates[-1] > 0:
        last = int(e.index[int(np.searchsorted(e.updates, e.updates[-1]))])
        if t[-1] - t[last] > x.baseline.loop.monitor.memory:
            message = "at rest or in the dead zone to the end: nothing is known about this time"
            told.append(
                Warning(kind="rest", from_s=float(t[last]), to_s=float(t[-1]), count=len(t) - last, message=message)
            )
    return told
