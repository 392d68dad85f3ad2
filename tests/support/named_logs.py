"""Logs with the names of many makers' tools: simulated loops, their right columns written down beside each.

`makers.toml` has the names and their sources. On those of `makers_unseen.toml` nothing is tuned.
"""

from __future__ import annotations

import csv
import re
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import ServoscopeError
from servoscope.learning.proposal import propose_columns
from servoscope.signals.readers import list_channels, read

FAMILIES = {"seen": "makers.toml", "unseen": "makers_unseen.toml"}
TO_SI = {
    **dict.fromkeys(("", "m", "rad", "rad/s", "counts", "inc", "qc", "pulse", "%", "A", "V", "N", "Nm", "s"), 1.0),
    **dict.fromkeys(("mm", "mA", "ms"), 1e-3), **dict.fromkeys(("um", "us"), 1e-6),
    **dict.fromkeys(("deg", "Grad", "deg/s"), np.pi / 180.0), "rev": 2.0 * np.pi, "rpm": np.pi / 30.0,
}  # fmt: skip
# amplitude, and the middles about which it moves
SPAN: dict[str, tuple[float, tuple[float, ...]]] = {
    "": (1.0, (0.0, 0.0, 5.0)), "m": (0.08, (0.0, 0.4)), "mm": (80.0, (0.0, 300.0, 600.0)), "um": (60.0, (0.0, 100.0)),
    "rad": (1.0, (0.0, 0.0, 3.0)), "deg": (60.0, (0.0, 180.0)), "Grad": (60.0, (0.0, 180.0)), "rev": (3.0, (0.0, 12.0)),
    "%": (12.0, (50.0,)), **dict.fromkeys(("counts", "inc", "qc", "pulse"), (40000.0, (0.0, 250000.0))),
    "deg/s": (80.0, (0.0,)), "rpm": (1500.0, (0.0,)), "rad/s": (150.0, (0.0,)),
}  # fmt: skip
EFFORT = {"": 1.0, "A": 3.0, "mA": 900.0, "%": 40.0, "Nm": 4.0, "V": 5.0, "N": 150.0}
EFFORT_WORDS = {  # what an effort may be measured in, by what its name says
    r"(?i)curr|strom|^i[ _]|iq|icmd|\.i$|IL\.|ISQ|q_A": ("A", "mA", "%", ""),
    r"(?i)torque|moment|tau|tor|TRQ": ("Nm", "%", ""),
    r"(?i)volt|spannung": ("V", "%", ""), r"(?i)pwm|load|duty": ("%", ""),
}  # fmt: skip
STYLES = ("{} [{}]", "{} ({})", "{}_{}", "{} / {}", "row", "none")


class Outcome(StrEnum):
    """What became of a log."""

    RIGHT = "right"
    REFUSED = "refused"  # an error, or a column left to the user
    UNIT = "wrong unit in silence"
    WRONG = "wrong in silence"


@dataclass(frozen=True)
class NamedLog:
    """One log, and the right values of t, r, u and y in SI units: each of `answers` is right."""

    file: str
    maker: str
    header: tuple[str, ...]
    values: FloatArray  # rows, columns
    separator: str
    decimal: str
    units: tuple[str, ...]  # a row of its own; () without
    answers: tuple[tuple[FloatArray, ...], ...]
    words: str  # the answer, in names

    def write(self, folder: Path) -> Path:
        """Write it, and return its path."""
        path = folder / self.file
        with path.open("w", encoding="utf-8", newline="") as file:
            rows = csv.writer(file, delimiter=self.separator)
            rows.writerow(self.header)
            if self.units:
                rows.writerow(self.units)
            for row in self.values:
                rows.writerow([f"{x:.10g}".replace(".", self.decimal) for x in row])
        return path


def move(rng: np.random.Generator, steps: int, dt: float) -> FloatArray:
    """Return smooth moves between random places within -1 and 1, with rests."""
    path, at = [], 0.0
    while len(path) < steps:
        goal = rng.uniform(-1.0, 1.0)
        s = np.linspace(0.0, 1.0, int((0.15 + 0.4 * abs(goal - at) ** 0.5) * rng.uniform(0.8, 2.0) / dt))
        path += list(at + (goal - at) * s**3 * (10.0 - 15.0 * s + 6.0 * s * s)) + [goal] * int(rng.uniform(0, 0.3) / dt)
        at = goal
    return np.array(path[:steps])


@cache
def simulate(rig: str, seed: int) -> dict[str, FloatArray]:
    """Return the signals of a loop, of unit amplitude: position or speed of an axis (1 kHz), a slow process (10 Hz)."""
    rng = np.random.default_rng([seed, len(rig)])
    dt, steps = (0.1, 20000) if rig == "process" else (1e-3, 32000)
    inertia, viscous, dry, load = (
        0.02 * rng.uniform(0.7, 1.4),
        0.03,
        0.08 * rng.uniform(0.5, 1.5),
        rng.uniform(-0.1, 0.1),
    )
    if rig == "process":
        r = np.repeat(np.clip(np.cumsum(rng.normal(0.0, 0.6, 80)), -1.0, 1.0), steps // 80)
    else:
        r = move(rng, steps, dt)
    v_set = np.gradient(r) / dt
    a_set = np.gradient(v_set) / dt
    y, v, u, integral = np.zeros(steps), np.zeros(steps), np.zeros(steps), 0.0
    noise = rng.standard_normal(steps)
    x = speed = 0.0
    for k in range(steps):
        y[k], v[k] = (speed if rig == "speed" else x), speed
        if rig == "process":
            e = r[k] - x - 1e-3 * noise[k]
            integral += 0.15 * e * dt
            u[k] = 0.8 * e + integral
            x += (u[k] - x + load) / 6.0 * dt
            continue
        wanted = r[k] if rig == "speed" else v_set[k] + 40.0 * (r[k] - x - 2e-5 * noise[k])
        e = wanted - speed
        integral += 300.0 * inertia * 40.0 * e * dt
        u[k] = 300.0 * inertia * e + integral
        speed += (u[k] - viscous * speed - dry * np.tanh(speed / 2e-3) - load) / inertia * dt
        x += speed * dt
    y = y + (2e-3 if rig == "speed" else 2e-5 if rig == "axis" else 1e-3) * rng.standard_normal(steps)
    scale = float(np.max(np.abs(u))) or 1.0
    u = u / scale
    t = np.arange(steps) * dt
    lagged = np.convolve(u, [0.4, 0.4, 0.2])[:steps]
    plan = (inertia * a_set + viscous * v_set + dry * np.tanh(v_set / 2e-3)) / scale
    return {
        "t": t, "r": r, "u": u, "y": y, "u_act": lagged + 0.004 * rng.standard_normal(steps), "v": v, "v_set": v_set,
        "a_set": a_set, "error": r - y, "bus": 1.0 - 0.004 * np.abs(u) + 1e-3 * rng.standard_normal(steps),
        "temperature": 35.0 + 4.0 * (1.0 - np.exp(-t / 300.0)) + 0.05 * np.round(rng.standard_normal(steps)),
        "word": 1591.0 + 8.0 * (np.abs(v_set) > 0.05), "zero": np.zeros(steps), "id": 0.01 * rng.standard_normal(steps),
        "load": 100.0 * np.sqrt(np.convolve(u**2, np.full(400, 1 / 400))[:steps]), "plan": plan, "rising": 1e-4 * t,
        "distance": np.round(1e3 * np.cumsum(np.abs(v)) * dt), "noise": rng.standard_normal(steps),
        "throttle": 0.3 + 0.02 * np.convolve(rng.standard_normal(steps), np.full(50, 1 / 50))[:steps],
    }  # fmt: skip


def with_unit(name: str, unit: str, style: str) -> str:
    """Return a name with its unit, as a tool writes it."""
    if not unit or style in ("row", "none"):
        return name
    if style == "{}_{}":
        unit = {"%": "pct"}.get(unit, unit).replace("/", "_")
    return style.format(name, unit)


def unit_of(kind: str, position: str, effort: str) -> str:
    """Return the unit of a signal."""
    if kind in ("v", "v_set", "a_set"):
        return f"{position}/s{'²' * (kind == 'a_set')}" if position and "/" not in position else ""
    named = {"r": position, "y": position, "error": position, "u": effort, "u_act": effort, "plan": "Nm", "id": "A"}
    return {**named, "bus": "V", "temperature": "°C"}.get(kind, "")


def make(maker: dict[str, Any], number: int) -> NamedLog:
    """Return one log of a maker's family."""
    rng = np.random.default_rng([number, *maker["maker"].encode()])
    rig = maker.get("rig", "axis")
    names: list[str] = maker["names"][number % len(maker["names"])]
    style = STYLES[rng.integers(len(STYLES))]
    pick = lambda units: units[min(rng.integers(len(units) + 1), len(units)) - 1]  # noqa: E731 - the last twice
    fitting = next((units for word, units in EFFORT_WORDS.items() if re.search(word, names[1])), maker["effort"])
    efforts = [unit for unit in maker["effort"] if unit in fitting] or [""]
    position, effort = pick(maker["position"][::-1]), pick(efforts[::-1])
    if style == "none":
        shown_position = shown_effort = ""
    else:
        shown_position, shown_effort = position, effort
    prefix = maker["prefixes"][rng.integers(len(maker["prefixes"]))]
    prefixes = [prefix]
    if re.search(r"1\D*$", prefix) and rng.random() < 0.3:
        prefixes.append(re.sub(r"1(\D*)$", r"2\1", prefix))
    rates = (10, 5, 2, 1) if rig == "process" else (1000, 500, 250, 200, 100, 50)
    base = rates[0]
    rate = int(rng.choice(rates))
    rows = int(rng.integers(600, 2000 if rig == "process" else min(32 * rate, 4000)))
    every = base // rate
    amplitude, middles = SPAN[position]
    middle = float(rng.choice(middles))
    kinds: dict[str, str] = {}
    answers, words = [], []
    columns: list[tuple[str, str, FloatArray]] = []  # name, unit shown, values
    for axis, before in enumerate(prefixes):
        signals = simulate(rig, int(rng.integers(4)) + 4 * axis)
        one: dict[str, list[FloatArray]] = {}
        kinds = {}
        for role, written in zip("ruy", names, strict=True):
            for place, name in enumerate(written.split("|")):
                if place and rng.random() < 0.4:
                    continue
                kinds[name] = ("u_act" if place else role) if role == "u" else role
        for name, kind in maker["others"].items():
            if rng.random() < 0.6 and not (kind == "u_act" and "u_act" in kinds.values()) and name not in kinds:
                kinds[name] = kind
        for name, kind in kinds.items():
            values = signals[kind][::every][:rows]
            scaled = scale(values, kind, position, amplitude, middle, EFFORT[effort])
            if rig == "process" and effort == "%" and kind in ("u", "u_act"):
                scaled += 50.0  # a valve between 10 and 90 %
            shown = unit_of(kind, shown_position, shown_effort) if style != "none" else ""
            columns.append((with_unit(before + name, shown, style), shown, scaled))
            role = {"u_act": "u"}.get(kind, kind)
            if role in "ruy" and any(name in n.split("|") for n in names):
                unit = shown_effort if role == "u" else shown_position
                unit = "rpm" if re.search(r"(?<!e)rpm$", name) else unit
                one.setdefault(role, []).append(scaled * TO_SI[unit])
        answers += [(one["r"][0], u, one["y"][0]) for u in one["u"]]
        words.append(", ".join(f"{role}={before}{name}" for role, name in zip("ruy", names, strict=True)))
    order = rng.permutation(len(columns)) if rng.random() < 0.5 else np.arange(len(columns))
    columns = [columns[i] for i in order]
    time_name, time_unit = maker["times"][rng.integers(len(maker["times"]))].split("|")
    stated = re.search(r"(?i)^ms_|us$", time_name)
    if style == "none" and not stated:
        time_unit = "s"
    t = np.arange(rows) / rate
    begin = 0.0 if rng.random() < 0.7 else 12.5
    shown = "" if stated or style == "none" else time_unit
    columns.insert(0, (with_unit(time_name, shown, style), shown, np.round((begin + t) / TO_SI[time_unit], 9)))
    separator, decimal = [(",", "."), (";", ","), ("\t", "."), (";", ".")][rng.integers(4)]
    file = re.sub(r"\W+", "_", f"{maker['maker']}_{number}".lower()) + ".csv"
    units = tuple(unit for _, unit, _ in columns) if style == "row" else ()
    values = np.column_stack([np.array([float(f"{x:.10g}") for x in column]) for _, _, column in columns])
    truth = tuple((t, *answer) for answer in answers)
    header = tuple(name for name, _, _ in columns)
    return NamedLog(file, maker["maker"], header, values, separator, decimal, units, truth, "; ".join(words))


def scale(values: FloatArray, kind: str, position: str, amplitude: float, middle: float, effort: float) -> FloatArray:
    """Return a signal in the units of a log: counts are whole numbers."""
    if kind in ("r", "y"):
        scaled = middle + amplitude * values
        return np.round(scaled) if position in ("counts", "inc", "qc", "pulse") else scaled
    if kind in ("v", "v_set", "a_set", "error"):
        return amplitude * values
    if kind in ("u", "u_act", "plan"):
        return effort * values
    return 48.0 * values if kind == "bus" else values


def makers(family: str = "seen") -> list[dict[str, Any]]:
    """Return the makers of a family: names, their page, rig and units of each."""
    text = Path(__file__).with_name(FAMILIES[family]).read_text(encoding="utf-8")
    return list(tomllib.loads(text)["maker"])


def named_logs(each: int = 10, only: Sequence[str] = (), family: str = "seen") -> Iterator[NamedLog]:
    """Return so many logs of each maker of a family, or of those that `only` names."""
    for maker in makers(family):
        if not only or maker["maker"] in only:
            yield from (make(maker, number) for number in range(each))


def find_outcome(log: NamedLog, folder: Path) -> tuple[Outcome, str]:
    """Write a log, let its columns be proposed, read it, compare it with its answers; return what was proposed, too."""
    path = log.write(folder)
    try:
        columns = propose_columns(path, list_channels(path))
        said = f"r={columns.reference} u={columns.input} y={columns.output}"
        found = read(path, columns=columns)
    except ServoscopeError as error:
        return Outcome.REFUSED, str(error)
    asked = columns.reference == "r" and "r" not in log.header  # no reference is proposed: the user is asked for it
    for t, r, u, y in log.answers:
        if len(found.t) == len(t) and np.allclose(found.t - found.t[0], t, rtol=1e-6, atol=1e-6):
            each = [_ratio(a, b) for a, b in ((found.r, r), (found.u, u), (found.y, y))[asked:]]
            if all(x is not None for x in each):
                if asked:
                    return Outcome.REFUSED, said
                return (Outcome.RIGHT if _fits(each) else Outcome.UNIT), said
    return Outcome.WRONG, said


def _ratio(found: FloatArray, right: FloatArray) -> float | None:
    """Return the factor between what was found and what is right, or None if these are two signals."""
    factor = float(found @ right) / (float(right @ right) or 1.0)
    spread = float(np.ptp(right)) or 1.0
    return factor if np.allclose(found, factor * right, atol=1e-6 * abs(factor) * spread) and factor else None


def _fits(factors: Sequence[float | None]) -> bool:
    """Tell whether r, u and y have SI units; those in percent may also be fractions of one."""
    return all(f is not None and any(np.isclose(f, x, rtol=1e-6) for x in (1.0, 0.01)) for f in factors)
