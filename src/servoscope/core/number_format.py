"""Numbers to the digits that their uncertainty supports, as plain text."""

from __future__ import annotations

import math

MAX_DIGITS = 5  # of a ratio: a change of 2 % is then shown to a hundredth of itself


def count_decimals(uncertainty: float, most: int = 6) -> int:
    """Return how many decimals show the first digit of an uncertainty, or two where they are below 35."""
    if not uncertainty > 0.0:
        return 3
    return min(max(-math.floor(math.log10(uncertainty / 3.5)), 0), most)


def ratio_digits(ratio: float, low: float, high: float) -> str:
    """Return the format specification that shows a ratio and its interval to the digits that the interval supports."""
    if not math.isfinite(high - low):
        return ".4g"
    size = max(abs(ratio), abs(low), abs(high), 1e-12)
    return f".{min(count_decimals((high - low) / 2.0), max(MAX_DIGITS - 1 - math.floor(math.log10(size)), 0))}f"


def format_ratios(ratio: float, low: float, high: float) -> tuple[str, str, str]:
    """Return a ratio and its interval, all to the digits that the interval supports."""
    digits = ratio_digits(ratio, low, high)
    return format(ratio, digits), format(low, digits), format(high, digits)


def format_short(value: float) -> str:
    """Return a value to three digits, without an exponent where it is merely large."""
    return f"{value:.0f}" if 100.0 <= abs(value) < 1e6 else f"{value:.3g}"


def format_rough(value: float) -> str:
    """Return a value to two digits, without an exponent where it is merely large."""
    return f"{float(f'{value:.2g}'):.0f}" if 99.5 <= abs(value) < 1e6 else f"{value:.2g}"


def format_share(share: float) -> str:
    """Return a share in per cent: 99.3 %, and 99.97 % rather than 100 %."""
    left = 1.0 - share
    digits = 1 if left > 0.01 or left <= 0.0 else min(math.ceil(-math.log10(left)) - 1, 6)
    return f"{100.0 * max(share, 0.0):.{digits}f} %"


def round_down(x: float, digits: int = 2) -> float:
    """Return the largest number of so many digits that is not above x > 0."""
    decimals = digits - 1 - math.floor(math.log10(x))
    return float(f"{math.floor(round(x * 10.0**decimals, 6)) * 10.0**-decimals:.{digits}g}")
