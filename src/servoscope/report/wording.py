"""Numbers, names and times as people read them: digits, units, symbols; as plain text and as HTML."""

from __future__ import annotations

import html
import math
import re
from collections.abc import Mapping, Sequence

import numpy as np

from servoscope import digits
from servoscope.diagnosis import UNKNOWN
from servoscope.plants import FloatArray

__all__ = [
    "axis_scale",
    "change",
    "clock_time",
    "correlation",
    "count",
    "factors",
    "meaning",
    "number",
    "plain_symbol",
    "probability",
    "quantity",
    "ratios",
    "signed_percent",
    "size_of",
    "symbol",
    "time_decimals",
    "times",
    "with_std",
    "with_symbols",
]

GREEK = {"theta": "θ", "beta": "β", "rho": "ρ"}
SUBSCRIPTS = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")
PREFIXES = ((1.0, ""), (1e3, "m"), (1e6, "µ"), (1e9, "n"))
DASH = "–"


def symbol(name: str) -> str:
    """Return a parameter's name as HTML: C_ie with a subscript, viscous_friction in words."""
    found = re.fullmatch(r"([A-Za-z]{1,5})(?:_(\w{1,3}))?", name)
    if found is None:
        return html.escape(name.replace("_", " "))
    stem, index = found.groups()
    letters = GREEK.get(stem, stem if index or len(stem) == 1 else None)
    if letters is None:
        return html.escape(name)
    return f"<i>{html.escape(letters)}</i>" + (f"<sub>{html.escape(index)}</sub>" if index else "")


def plain_symbol(name: str) -> str:
    """Return the same as plain text for a picture; dollar signs are kept from being read as mathematics."""
    found = re.fullmatch(r"(theta|beta|rho)(?:_(\d+))?", name)
    if found is not None:
        return GREEK[found[1]] + (found[2] or "").translate(SUBSCRIPTS)
    short = re.fullmatch(r"[A-Za-z]{1,2}_\w{1,3}", name)
    return (name if short else name.replace("_", " ")).replace("$", r"\$")


def with_symbols(text: str) -> str:
    """Return a sentence as HTML, with parameters as symbols and factors with a true sign."""
    told = re.sub(
        r"\b(?:theta_\d+|beta|rho|[A-Za-z]{1,2}_\w{1,3})\b", lambda found: symbol(found[0]), html.escape(text)
    )
    return re.sub(r"\bx (?=\d)", "× ", told)


def correlation(covariance: Sequence[Sequence[float]]) -> float:
    """Return that of two sizes, from their covariance (2, 2)."""
    scale = math.sqrt(covariance[0][0] * covariance[1][1])
    return covariance[0][1] / scale if scale > 0.0 else math.nan


def number(value: float | None, digits: int = 4) -> str:
    """Return a number with so many significant digits as HTML; very small and large ones as powers of ten."""
    if value is None or not math.isfinite(value):
        return DASH
    if value == 0.0:
        return "0"
    exponent = math.floor(math.log10(abs(value)))
    if -4 <= exponent < 6:
        return _signed(f"{value:.{max(digits - 1 - exponent, 0)}f}")
    return _signed(f"{value / 10.0**exponent:.{digits - 1}f}") + _power(exponent)


def count(value: int) -> str:
    """Return a whole number with thin spaces between the thousands."""
    return _signed(f"{value:,}".replace(",", "\N{THIN SPACE}"))


def quantity(value: float) -> str:
    """Return a setting as it was written, with a true minus sign and powers of ten, as HTML."""
    text = f"{value:.10g}" if abs(value) < 1e6 else re.sub(r"\.?0*e", "e", f"{value:.9e}")
    mantissa, _, exponent = text.partition("e")
    return _signed(mantissa) + (_power(int(exponent)) if exponent else "")


def with_std(value: float, std: float, *others: float) -> tuple[str, ...]:
    """Return value, standard deviation and further values, all to the digits that the deviation supports.

    Returns
    -------
    tuple of str
        As HTML, in the order of the arguments.
    """
    values = (value, std, *others)
    if not (math.isfinite(value) and math.isfinite(std) and std > 0.0):
        return tuple(number(each) for each in values)
    top = max((abs(each) for each in values if math.isfinite(each)), default=0.0)
    exponent = math.floor(math.log10(top)) if top > 0.0 else 0
    exponent = 0 if -3 <= exponent < 6 else exponent
    decimals = digits.decimals(std / 10.0**exponent, most=7)
    power = _power(exponent) if exponent else ""
    return tuple(
        _signed(f"{each / 10.0**exponent:.{decimals}f}") + power if math.isfinite(each) else DASH for each in values
    )


def probability(value: float | None) -> str:
    """Return a probability in percent, never rounded to certainty."""
    if value is None or not math.isfinite(value):
        return DASH
    if value > 0.999:
        return "> 99.9 %"
    if value < 0.001:
        return "< 0.1 %"
    return f"{100.0 * value:.1f} %"


def signed_percent(change: float) -> str:
    """Return a relative change in percent with its sign; large ones as a factor."""
    if not math.isfinite(change):
        return DASH
    if abs(change) >= 2.0:
        return f"× {number(1.0 + change, 3)}"
    text = f"{100.0 * change:+.2f}" if abs(change) < 0.1 else f"{100.0 * change:+.1f}"
    return _signed(text) + " %"


def change(ratio: float | None) -> str:
    """Return from which ratio on something holds: as +2.5 %, as a factor where it is far from one; None: never."""
    if ratio is None:
        return "never"
    return _signed(f"{100.0 * (ratio - 1.0):+.3g} %") if 0.5 < ratio < 2.0 else f"× {ratio:.3g}"


def size_of(ratio: float, low: float, high: float) -> tuple[str, str, str]:
    """Return a fault's size and its interval: as +20 %, or as a factor where it is large.

    All to the digits that the interval supports.
    """
    values = (ratio, low, high)
    if all(0.2 <= value < 3.0 for value in values):
        decimals = digits.decimals(50.0 * (high - low))
        changes = (_signed(f"{100.0 * (value - 1.0):+.{decimals}f}") + " %" for value in values)
        return tuple(changes)  # type: ignore[return-value]
    return factors(*values)


def factors(ratio: float, low: float, high: float) -> tuple[str, str, str]:
    """Return a size and its interval as factors, which is what shares of a labelled severity are."""
    ratio_, low_, high_ = ratios(ratio, low, high)
    return f"× {ratio_}", f"× {low_}", f"× {high_}"


def ratios(ratio: float, low: float, high: float) -> tuple[str, str, str]:
    """Return a ratio and its interval to the digits that the interval supports."""
    if not math.isfinite(high - low):
        return number(ratio), number(low), number(high)
    return tuple(_signed(text) for text in digits.ratios(ratio, low, high))  # type: ignore[return-value]


def time_decimals(width: float) -> int:
    """Return with how many decimals times [s] are told that are known to within `width` [s]."""
    return min(max(digits.decimals(width), 1), 4)


def clock_time(seconds: float, decimals: int = 1) -> str:
    """Return a time on the recording's clock, with hours and minutes added where it is long."""
    text = _signed(f"{seconds:.{decimals}f}") + " s"
    if not 600.0 <= seconds < math.inf:
        return text
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{text} ({f'{hours} h ' if hours else ''}{minutes} min {rest} s)"


def meaning(name: str, words: Mapping[str, str], ratio: float = 1.0) -> str:
    """Return what a candidate means, in plain words.

    Parameters
    ----------
    name
        Of the candidate, several faults joined by " + ".
    words
        Name of a fault -> its words; what they say in brackets is left out.
    ratio
        Of the parameter, where there is one: below 1, what words call more is less.
    """
    if name == UNKNOWN:
        return "none of the known faults"
    text = " and ".join(words.get(part, part.replace("_", " ")).partition(" (")[0] for part in name.split(" + "))
    return re.sub("^more ", "less ", text) if ratio < 1.0 else text


def times(duration_s: float) -> tuple[str, float]:
    """Return the unit of a time axis and how many seconds it has."""
    if duration_s > 4.0 * 3600.0:
        return "h", 3600.0
    return ("min", 60.0) if duration_s > 1200.0 else ("s", 1.0)


def axis_scale(values: Sequence[FloatArray], unit: str) -> tuple[str, float]:
    """Return a unit with a prefix that suits the values, and the factor that goes with it."""
    if not unit:
        return "", 1.0
    top = max((float(np.nanmax(np.abs(x))) for x in values if np.isfinite(x).any()), default=0.0)
    for factor, prefix in PREFIXES:
        if top * factor >= 0.5:
            return prefix + unit, factor
    return unit, 1.0


def _signed(text: str) -> str:
    return text.replace("-", "−")


def _power(exponent: int) -> str:
    return f" × 10<sup>{_signed(str(exponent))}</sup>"
