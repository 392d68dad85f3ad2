"""The verdict in one sentence."""

from __future__ import annotations

from collections.abc import Sequence

from servoscope.diagnosis import UNKNOWN, Candidate, FoundFault, Verdict, Warning


def summary(
    verdict: Verdict,
    faults: tuple[FoundFault, ...],
    candidates: tuple[Candidate, ...],
    since: str,
    seen: dict[str, tuple[float, float]],
    warnings: Sequence[Warning],
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
        (fault,) = faults
        low, high = fault.interval
        if fault.learned:
            return (
                f"Fault{here}: {fault.name}, as labelled recordings show it, at {fault.ratio:.3g} times the labelled "
                f"severity ({low:.3g} to {high:.3g}) {since}."
            )
        what = "It" if fault.parameter == fault.name else fault.parameter
        return (
            f"Fault{here}: {fault.name}. {what} is {fault.ratio:.4g} times its healthy value ({low:.4g} to "
            f"{high:.4g}) {since}."
        )
    likely = [c for c in candidates if c.probability >= 0.05]
    if likely[0].name == UNKNOWN and likely[0].probability >= 0.5:
        return f"Fault{here}, unknown: a change {since} that no single known fault explains."
    listed = " or ".join(f"{c.name} ({_share(c.probability)})" for c in likely)
    return f"Fault{here} {since}, not to be told apart here: {listed}."


def _share(probability: float) -> str:
    return "> 99.9 %" if probability > 0.999 else f"{100.0 * probability:.3g} %"
