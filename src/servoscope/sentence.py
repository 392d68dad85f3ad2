"""The verdict in one sentence."""

from __future__ import annotations

from collections.abc import Sequence

from servoscope import digits
from servoscope.diagnosis import UNKNOWN, Candidate, FoundFault, Refit, Verdict, Warning

LIKELY = 0.05  # probability from which an explanation is told


def summary(
    verdict: Verdict,
    faults: tuple[FoundFault, ...],
    candidates: tuple[Candidate, ...],
    since: str,
    seen: dict[str, tuple[float, float]],
    warnings: Sequence[Warning],
    refit: Refit | None = None,
    point: str = "",
) -> str:
    """Say it.

    Parameters
    ----------
    verdict, faults, candidates, warnings
        Of the diagnosis.
    since
        "since ...", or nothing.
    seen
        By parameter, the smallest change that would have shown, and what the baseline promises.
    refit
        Of the diagnosis.
    point
        Operating point that the recording was judged at, or nothing.
    """
    here = f" at {point}" if point else ""
    if verdict == "healthy":
        smallest = sorted((size, parameter) for parameter, (size, _) in seen.items())
        told = ", ".join(f"{parameter} {100.0 * size:.3g} %" for size, parameter in smallest)
        return f"Healthy{here}: no change that would have shown here (from {told} on)."
    if verdict == "undetermined":
        reason = next(warning.message for warning in warnings if warning.kind == "power")
        return f"Undetermined{here}: {reason}."
    if faults:
        names = " and ".join(fault.name for fault in faults)
        return f"Fault{here}: {names}{_sizes(faults)} {since}.{_same(refit)}"
    likely = [c for c in candidates if c.probability >= LIKELY]
    if likely[0].name == UNKNOWN and (likely[0].probability >= 0.5 or len(likely) == 1):
        known = "no known fault and no pair of them explains" if refit else "no single known fault explains"
        return f"Fault{here}, unknown: a change {since} that {known}.{_would(refit)}"
    return f"Fault{here} {since}{_open(likely)}."


def _open(likely: Sequence[Candidate]) -> str:
    """Say which explanations remain, and what they confuse."""
    known = [c for c in likely if c.name != UNKNOWN]
    listed = [f"{c.name} ({_share(c.probability)})" for c in known]
    none = [f"no known fault ({_share(c.probability)})" for c in likely if c.name == UNKNOWN]
    if len(known) == 1:
        return f": {listed[0]}, or {none[0]}" if none else f": {listed[0]}, which is too little to name it"
    several = [{fault.parameter for fault in c.faults} for c in known if len(c.faults) > 1]
    told = ", not to be told apart here"
    if len(several) == len(known):
        every = [parameter for each in several for parameter in each]
        confused = sorted(parameter for parameter in set(every) if every.count(parameter) < len(several))
        told = f": two at once, not to be resolved here, because {' and '.join(confused)} are confused"
    return f"{told}: {' or '.join(listed + none)}"


def _sizes(faults: Sequence[FoundFault]) -> str:
    """Say how large named faults are, so that a name may stand before it."""
    each: list[str] = []
    for fault in faults:
        ratio, low, high = digits.ratios(fault.ratio, *fault.interval)
        if fault.learned:
            return f", as labelled recordings show it, at {ratio} times the labelled severity ({low} to {high})"
        times = "times its healthy value" if not each else "times"
        each.append(f"{fault.parameter} {'' if each else 'is '}{ratio} {times} ({low} to {high})")
    if len(faults) == 1 and faults[0].parameter == faults[0].name:
        each[0] = each[0].replace(faults[0].name, "It", 1)
    return f". {' and '.join(each)}"


def _same(refit: Refit | None) -> str:
    """Name the likeliest cause outside the list that does what the named fault does."""
    return f" It looks the same as {refit.mimics[0].words}." if refit and refit.mimics else ""


def _would(refit: Refit | None) -> str:
    """Name the likeliest cause outside the list that explains what no fault does."""
    words = refit.mimics[0].words if refit and refit.mimics else ""
    return f" {words[:1].upper()}{words[1:]} would explain it." if words else ""


def _share(probability: float) -> str:
    return "> 99.9 %" if probability > 0.999 else f"{100.0 * probability:.3g} %"
