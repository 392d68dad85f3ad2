"""Numbers, names and times as people read them: digits, units, symbols; the same text in a terminal and on a page."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence

import numpy as np

from servoscope.core import number_format
from servoscope.core.arrays import FloatArray
from servoscope.core.messages import translate
from servoscope.diagnosis.change_words import fault_label
from servoscope.isolation.candidate import UNKNOWN, Candidate, FaultEstimate

GREEK = {"theta": "θ", "beta": "β", "rho": "ρ"}
SUBSCRIPTS = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
SYMBOL = re.compile(r"\b(theta_\d+|beta|rho|[A-Za-z]{1,2}_\w{1,3})\b")  # in a sentence
PREFIXES = ((1.0, ""), (1e3, "m"), (1e6, "µ"), (1e9, "n"))
DASH = "–"


def plain_name(name: str) -> str:
    """Return a name of the code as words: viscous friction."""
    return name.replace("_", " ")


def symbol_parts(name: str) -> tuple[str, str] | None:
    """Return a parameter's symbol and its subscript, C and ie of C_ie; None where the name is words."""
    match = re.fullmatch(r"([A-Za-z]{1,5})(?:_(\w{1,3}))?", name)
    if match is None:
        return None
    stem, index = match[1], match[2] or ""
    letters = GREEK.get(stem, stem if index or len(stem) == 1 else "")
    return (letters, index) if letters else None


def parameter_label(name: str) -> str:
    """Return a parameter as its symbol, C_ie, or in words."""
    return name if symbol_parts(name) else translate(fault_label(name))


def text_symbol(name: str) -> str:
    """Return a parameter's name as plain text for a figure; dollar signs are kept from being read as mathematics."""
    match = re.fullmatch(r"(theta|beta|rho)(?:_(\d+))?", name)
    if match is not None:
        return GREEK[match[1]] + (match[2] or "").translate(SUBSCRIPTS)
    short = re.fullmatch(r"[A-Za-z]{1,2}_\w{1,3}", name)
    return (name if short else plain_name(name)).replace("$", r"\$")


def split_symbols(text: str) -> list[str]:
    """Return a sentence in parts, every second of which is a parameter's name, with true signs of factors."""
    factors = re.sub(r"\bx (?=\d)", "× ", text)
    return SYMBOL.split(re.sub(r"(?<=\d) (?=%|m?s\b|Hz\b)", "\N{NO-BREAK SPACE}", factors))


def pair_correlation(covariance: Sequence[Sequence[float]]) -> float:
    """Return the correlation of two sizes from their covariance (2, 2)."""
    scale = math.sqrt(covariance[0][0] * covariance[1][1])
    return covariance[0][1] / scale if scale > 0.0 else math.nan


def format_number(value: float | None, digits: int = 4) -> str:
    """Return a number with so many significant digits; very small and large ones as powers of ten."""
    if value is None or not math.isfinite(value):
        return DASH
    if value == 0.0:
        return "0"
    exponent = math.floor(math.log10(abs(value)))
    if -4 <= exponent < 6:
        return _true_minus(f"{value:.{max(digits - 1 - exponent, 0)}f}")
    return _true_minus(f"{value / 10.0**exponent:.{digits - 1}f}") + _power(exponent)


def format_count(value: int) -> str:
    """Return a whole number with thin spaces between the thousands."""
    return _true_minus(f"{value:,}".replace(",", "\N{THIN SPACE}"))


def format_quantity(value: float) -> str:
    """Return a setting as it was written, with a true minus sign and powers of ten."""
    text = f"{value:.10g}" if abs(value) < 1e6 else re.sub(r"\.?0*e", "e", f"{value:.9e}")
    mantissa, _, exponent = text.partition("e")
    return _true_minus(mantissa) + (_power(int(exponent)) if exponent else "")


def format_with_std(value: float, std: float, *others: float) -> tuple[str, ...]:
    """Return value, standard deviation and further values, all to the digits that the deviation supports."""
    values = (value, std, *others)
    if not (math.isfinite(value) and math.isfinite(std) and std > 0.0):
        return tuple(format_number(value) for value in values)
    top = max((abs(value) for value in values if math.isfinite(value)), default=0.0)
    exponent = math.floor(math.log10(top)) if top > 0.0 else 0
    exponent = 0 if -3 <= exponent < 6 else exponent
    decimals = number_format.count_decimals(std / 10.0**exponent, most=7)
    power = _power(exponent) if exponent else ""
    return tuple(
        _true_minus(f"{value / 10.0**exponent:.{decimals}f}") + power if math.isfinite(value) else DASH
        for value in values
    )


def format_probability(value: float | None) -> str:
    """Return a probability in percent, never rounded to certainty."""
    if value is None or not math.isfinite(value):
        return DASH
    if value > 0.999:
        return "> 99.9 %"
    return "< 0.1 %" if value < 0.001 else f"{100.0 * value:.1f} %"


def format_percent(share: float | None) -> str:
    """Return a share with so many digits that 99.97 % does not become 100 %."""
    if share is None or not math.isfinite(share):
        return DASH
    if 0.0005 > share > 0.0:
        return "< 0.1 %"
    if 0.99 < share < 1.0:
        return f"{100.0 * share:.{min(math.ceil(-math.log10(1.0 - share)) - 1, 6)}f} %"
    return f"{100.0 * share:.3g} %"


def format_signed_percent(change: float) -> str:
    """Return a relative change in percent with its sign; large ones as a factor."""
    if not math.isfinite(change):
        return DASH
    if abs(change) >= 2.0:
        return f"× {format_number(1.0 + change, 3)}"
    text = f"{100.0 * change:+.2f}" if abs(change) < 0.1 else f"{100.0 * change:+.1f}"
    return _true_minus(text) + " %"


def format_change(ratio: float | None) -> str:
    """Return from which ratio on something holds: as +2.5 %, as a factor where it is far from one; None: never."""
    if ratio is None:
        return translate("never")
    return _true_minus(f"{100.0 * (ratio - 1.0):+.3g} %") if 0.5 < ratio < 2.0 else f"× {ratio:.3g}"


def format_ratios(ratio: float, low: float, high: float) -> tuple[str, str, str]:
    """Return a ratio and its interval to the digits that the interval supports."""
    if not math.isfinite(high - low):
        return format_number(ratio), format_number(low), format_number(high)
    first, second, third = (_true_minus(text) for text in number_format.format_ratios(ratio, low, high))
    return first, second, third


def format_size(ratio: float, low: float, high: float, *, factor: bool = False) -> tuple[str, str, str]:
    """Return a fault's size and its interval: as +20 %, or as a factor where it is large or `factor` asks for it.

    All to the digits that the interval supports.
    """
    if factor or not all(0.2 <= value < 3.0 for value in (ratio, low, high)):
        first, second, third = (f"× {text}" for text in format_ratios(ratio, low, high))
    else:
        decimals = number_format.count_decimals(50.0 * (high - low))
        changes = (f"{100.0 * (value - 1.0):+.{decimals}f} %" for value in (ratio, low, high))
        first, second, third = (_true_minus(text) for text in changes)
    return first, second, third


def time_decimals(width: float) -> int:
    """Return the number of decimals for times [s] that are known to within `width` [s]."""
    return min(max(number_format.count_decimals(width), 1), 4)


def format_clock_time(seconds: float, decimals: int = 1) -> str:
    """Return a time on the recording's clock, with hours and minutes added where it is long."""
    text = _true_minus(f"{seconds:.{decimals}f}") + " s"
    if not 600.0 <= seconds < math.inf:
        return text
    minutes, left = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{text} ({f'{hours} h ' if hours else ''}{minutes} min {left} s)"


def format_duration(seconds: float | None) -> str:
    """Return a duration in the unit that suits it."""
    if seconds is None:
        return DASH
    if seconds < 600.0:
        return f"{seconds:.4g} s"
    return f"{seconds / 60.0:.3g} min" if seconds < 7200.0 else f"{seconds / 3600.0:.3g} h"


def describe_fault(fault: FaultEstimate, words: Mapping[str, str], *, signed: bool = True) -> str:
    """Return a fault in the plain words of its plant, without what these say in brackets.

    `words`: by name of a fault; `signed`: below a ratio of 1, what they call more is less.
    """
    text = words.get(fault.name, plain_name(fault.name)).partition(" (")[0]
    return translate(re.sub("^more ", "less ", text) if signed and fault.ratio < 1.0 else text)


def describe_candidate(candidate: Candidate, words: Mapping[str, str]) -> str:
    """Return what a candidate means, in plain words; `words`: by name of a fault."""
    if candidate.name == UNKNOWN:
        return translate("none of the known faults")
    if not candidate.faults:  # a candidate without sizes: of an earlier version
        return translate(words.get(candidate.name, plain_name(candidate.name)).partition(" (")[0])
    alone = len(candidate.faults) == 1
    return f" {translate('and')} ".join(describe_fault(fault, words, signed=alone) for fault in candidate.faults)


def time_axis_unit(duration_s: float) -> tuple[str, float]:
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


def _true_minus(text: str) -> str:
    return text.replace("-", "−")


def _power(exponent: int) -> str:
    return f" × 10{str(exponent).translate(SUPERSCRIPTS)}"
