"""The verdict in one sentence."""

from __future__ import annotations

from collections.abc import Sequence

from servoscope.diagnosis import UNKNOWN, Candidate, FoundFault, Refit, Verdict, Warning


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
    same = _same(refit)
    if faults:
        each = ", ".join(_size(fault) for fault in faults)
        return f"Fault{here}: {' and '.join(fault.name for fault in faults)}. {each} {since}.{same}"
    likely = [c for c in candidates if c.probability >= 0.05]
    if likely[0].name == UNKNOWN and likely[0].probability >= 0.5:
        known = "no known fault and no pair of them explains" if refit else "no single known fault explains"
        return f"Fault{here}, unknown: a change {since} that {known}.{same}"
    listed = " or ".join(f"{c.name} ({_share(c.probability)})" for c in likely)
    several = [[fault.parameter for fault in c.faults] for c in likely if len(c.faults) > 1]
    if len(several) == len(likely) > 1:
        every = [name for names in several for name in names]
        confused = sorted(name for name in set(every) if every.count(name) < len(several))
        return (
            f"Fault{here} {since}: two at once, not to be resolved here, because {' and '.join(confused)} are "
            f"confused: {listed}."
        )
    return f"Fault{here} {since}, not to be told apart here: {listed}."


def _size(fault: FoundFault) -> str:
    low, high = fault.interval
    if fault.learned:
        interval = f"({low:.3g} to {high:.3g})"
        return f"As labelled recordings show it, at {fault.ratio:.3g} times the labelled severity {interval}"
    what = "It" if fault.parameter == fault.name else fault.parameter
    return f"{what} is {fault.ratio:.4g} times its healthy value ({low:.4g} to {high:.4g})"


def _same(refit: Refit | None) -> str:
    """Name the likeliest cause outside the list."""
    if refit is None or not refit.mimics:
        return ""
    return f" It looks the same as {refit.mimics[0].words}."


def _share(probability: float) -> str:
    return "> 99.9 %" if probability > 0.999 else f"{100.0 * probability:.3g} %"
