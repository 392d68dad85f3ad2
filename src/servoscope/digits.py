"""Numbers to the digits that their uncertainty supports, as plain text."""

from __future__ import annotations

import math

MOST = 5  # significant digits of a ratio; a change of 2 % is then told to a hundredth of itself


def decimals(uncertainty: float, most: int = 6) -> int:
    """Return how many decimals show the first digit of an uncertainty, or two where they are below 35."""
    if not uncertainty > 0.0:
        return 3
    return min(max(-math.floor(math.log10(uncertainty / 3.5)), 0), most)


def ratios(ratio: float, low: float, high: float) -> tuple[str, str, str]:
    """Return a ratio and its interval, all to the digits that the interval supports."""
    if not math.isfinite(high - low):
        return f"{ratio:.4g}", f"{low:.4g}", f"{high:.4g}"
    size = max(abs(ratio), abs(low), abs(high), 1e-12)
    places = min(decimals((high - low) / 2.0), max(MOST - 1 - math.floor(math.log10(size)), 0))
    return f"{ratio:.{places}f}", f"{low:.{places}f}", f"{high:.{places}f}"


def short(value: float) -> str:
    """Return a value to three digits, without an exponent where it is merely large."""
    return f"{value:.0f}" if 100.0 <= abs(value) < 1e6 else f"{value:.3g}"
