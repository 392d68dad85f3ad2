"""Units in the names of columns, and what a number in them is in SI units."""

from __future__ import annotations

import math
import re

RPM, DEG = 2.0 * math.pi / 60.0, math.pi / 180.0
# factor to the SI unit, by unit; what is in no SI unit at all (percent, counts) has 1
LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "µm": 1e-6, "um": 1e-6, "μm": 1e-6, "in": 0.0254, "inch": 0.0254}
ANGLES = {
    "rad": 1.0,
    "mrad": 1e-3,
    "deg": DEG,
    "°": DEG,
    "degree": DEG,
    "degrees": DEG,
    "grad": DEG,
    "Grad": DEG,
    "rev": 2 * math.pi,
}
COUNTS = {
    unit: 1.0 for unit in ("inc", "incr", "counts", "cts", "ticks", "pulse", "pulses", "steps", "qc")
}  # of an encoder
SPEEDS = {
    **{f"{unit}/s": 1.0 for unit in COUNTS},
    **{f"{unit}/s": factor for unit, factor in {**LENGTHS, **ANGLES}.items()},
    **{f"{unit}/min": factor / 60.0 for unit, factor in {**LENGTHS, **ANGLES}.items()},
    **{"rpm": RPM, "1/min": RPM, "U/min": RPM, "rev/min": RPM, "tr/min": RPM, "min-1": RPM, "r/min": RPM},
}
INPUTS = {
    **{"A": 1.0, "mA": 1e-3, "Arms": 1.0, "V": 1.0, "mV": 1e-3, "N": 1.0, "kN": 1e3, "Nm": 1.0, "N*m": 1.0, "N.m": 1.0},
    **{
        "N·m": 1.0,
        "mNm": 1e-3,
        "mbar": 1e2,
        "psi": 6894.757293168,
        "bar": 1e5,
        "Pa": 1.0,
        "kPa": 1e3,
        "MPa": 1e6,
        "%": 1.0,
        "pct": 1.0,
        "W": 1.0,
        "kW": 1e3,
    },
}
TIMES = ("s", "ms", "us", "µs", "ns", "min", "sec", "seconds", "h")
OTHER_UNITS = (
    "°C",
    "degC",
    "°F",
    "degF",
    "C",
    "K",
    "kg",
    "l/min",
    "L/min",
    "Ohm",
    "dB",
    "-",
    "Hz",
    "kHz",
    "m/s²",
    "m/s^2",
    "rad/s²",
    "rad/s^2",
    "1",
    "V/s",
)
FACTORS = {**LENGTHS, **ANGLES, **COUNTS, **SPEEDS, **INPUTS}
BRACKETED_UNIT = re.compile(r"^(.*?)\s*(?:\[\s*([^\[\]]+?)\s*\]|\(\s*([^()]+?)\s*\))\s*$")
INDEXED = re.compile(r"\w\[\d+\]$")  # an element of an array, q[1], is no quantity without a unit, q [1]
QUANTITY = re.compile(r"([-+]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][-+]?\d+)?)\s*([^\d\s].*)")  # 12.5 mm
BARE_UNIT = re.compile(r"^(.+?)(?:[_ ]|\s*/\s*)([A-Za-zµμ°%/]{1,9})$")  # a unit without brackets: pos_mm, t/ms

BARE_RATE = re.compile(r"^(.+?)[_ ]([A-Za-zµμ]{1,4})_(s|min)$")  # vel_mm_s


def with_unit(name: str, unit: str) -> str:
    """Return a column's name with its unit in brackets, unless it has one, or the unit is none that is known, or s."""
    told = unit and is_unit(unit) and unit not in ("1", "-", "s") and not split_unit(name)[1]
    return f"{name} [{unit}]" if told else name


def parse_quantity(text: str, name: str) -> float | None:
    """Return a number with its unit behind it, in the unit of its column's name, else in SI units; None: it is none."""
    match = QUANTITY.fullmatch(text)
    if match is None or not is_unit(match[2]):
        return None
    return float(match[1].replace(",", ".")) * FACTORS.get(match[2], 1.0) / si_factor(name)


def is_unit(text: str) -> bool:
    """Tell whether a text is a unit that is known."""
    return text in FACTORS or text in TIMES or text in OTHER_UNITS


def split_unit(name: str) -> tuple[str, str]:
    """Return a column's name without its unit, and the unit; empty where it has none that is known."""
    match = BRACKETED_UNIT.match(name)
    if match is not None and is_unit(unit := match[2] or match[3]):
        return (name, "") if INDEXED.search(name) else (match[1], unit)
    if name in SPEEDS:  # rpm
        return name, name
    rate = BARE_RATE.match(name)
    if rate is not None and (unit := f"{rate[2]}/{rate[3]}") in SPEEDS:
        return rate[1], unit
    loose = BARE_UNIT.match(name)
    # a single letter is a name more often than a unit: joint_A, r_m
    if loose is not None and is_unit(loose[2]) and (len(loose[2]) > 1 or loose[2] in "s°%" or " / " in name):
        return loose[1], loose[2]
    return name, ""


def si_factor(name: str) -> float:
    """Return what turns the numbers of a column into SI units, after the unit in its name; 1 if it has none."""
    return FACTORS.get(split_unit(name)[1], 1.0)
