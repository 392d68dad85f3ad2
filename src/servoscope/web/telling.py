"""Rows of the store in the words of the interface; plain functions on plain values."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, get_args

from servoscope.alarms import COMMANDS, PRIORITIES, TABLE, Ne107, State
from servoscope.ifrf import CHI2_95

__all__ = [
    "alarm",
    "asset_row",
    "detail_of",
    "diagnosis_row",
    "live_id",
    "service_row",
    "sizes",
    "transition",
    "worst_first",
]

Plain = dict[str, Any]
TWO_SIDED = 1.959963984540054  # standard deviations that hold 95 %
RANKS: tuple[Ne107, ...] = get_args(Ne107)
WAITING = (State.UNACKNOWLEDGED, State.RETURNED, State.LATCHED_UNACKNOWLEDGED)


def alarm(asset: str, name: str, said: Mapping[str, Any]) -> Plain:
    """Return an alarm with the commands that mean something in its state."""
    state = State(said["state"])
    return {
        "asset": asset,
        "alarm": name,
        "state": state.value,
        "since": said["since"],
        "priority": said.get("priority"),
        "cause": said.get("cause", ""),
        "until": said.get("until"),
        "commands": [command.value for command in COMMANDS if (state, command) in TABLE],
    }


def alarms(asset: str, said: Mapping[str, Any]) -> list[Plain]:
    """Return the alarms of a status that are not normal."""
    found = said.get("alarms", {}).items()
    return [alarm(asset, name, one) for name, one in found if one["state"] != State.NORMAL]


def asset_row(name: str, at: float, said: Mapping[str, Any], found_sizes: Sequence[Plain] = ()) -> Plain:
    """Return an asset as the fleet shows it; with the sizes of its faults, where a full diagnosis has named them."""
    standing = alarms(name, said)
    found = {
        "asset": name,
        "group": said.get("about", {}).get("group", ""),
        **{key: said[key] for key in ("verdict", "summary", "since", "onset", "examined", "ne107")},
        "reasons": list(said["reasons"]),
        "quality": list(said["quality"]),
        "statistic": said.get("statistic"),
        "level": said.get("level"),
        "deviation": deviation(said.get("residual", ())),
        "alarms": standing,
        "sizes": list(found_sizes),
        "t": said["counted"]["t"],
        "at": at,
    }
    return {**found, "severity": _severity(found)}


def sizes(said: Mapping[str, Any], document: Mapping[str, Any]) -> list[Plain]:
    """Return the sizes of the faults that a diagnosis of an asset names, in the words of its status."""
    words = said.get("about", {}).get("faults", {})
    return [
        {
            "name": fault["name"],
            "words": words.get(fault["name"], fault["name"]),
            "parameter": fault["parameter"],
            "ratio": fault["ratio"],
            "low": fault["interval"][0],
            "high": fault["interval"][1],
        }
        for fault in document.get("faults", ())
    ]


def deviation(residual: Iterable[Sequence[float | None]]) -> float | None:
    """Return the largest residual as a share of the healthy response."""
    shares = [
        math.hypot(real, imaginary) / healthy
        for _, real, imaginary, healthy in residual
        if real is not None and imaginary is not None and healthy
    ]
    return max(shares, default=None)


def _severity(row: Mapping[str, Any]) -> float:
    """Return how urgent an asset is: a fault, then the status, then what waits for somebody, then the statistics."""
    waiting = [
        PRIORITIES.index(one["priority"]) + 1 for one in row["alarms"] if one["state"] in WAITING and one["priority"]
    ]
    excess = min(max(row["statistic"] or 0.0, row["level"] or 0.0), 3.9)
    fault = 100.0 if row["verdict"] == "fault" else 0.0
    return fault + 20.0 * RANKS.index(row["ne107"]) + 4.0 * max(waiting, default=0) + round(excess, 3)


def worst_first(rows: Iterable[Plain]) -> list[Plain]:
    """Return rows of assets, the most urgent first."""
    return sorted(rows, key=lambda row: (-row["severity"], row["asset"]))


def service_row(name: str, said: Mapping[str, Any]) -> Plain:
    """Return what a service says of itself."""
    return {"service": name, "flood": said["flood"], "alarms": alarms(name, said)}


def detail_of(name: str, at: float, said: Mapping[str, Any], found_sizes: Sequence[Plain]) -> Plain:
    """Return an asset with all that its status says."""
    about = said.get("about", {})
    units = about.get("coefficient_units", ())
    return {
        **asset_row(name, at, said, found_sizes),
        "now": time.time(),
        "exceeded": said.get("exceeded"),
        "responses": [_response(*row) for row in said.get("responses", ())],
        "parameters": [
            _parameter(units[i] if i < len(units) else "", *row) for i, row in enumerate(said.get("parameters", ()))
        ],
        "counted": {key: value for key, value in said["counted"].items() if key not in ("digest", "rows")},
        "about": {
            **{key: about.get(key) for key in ("loop", "plant", "sample_rate_hz", "baseline", "point")},
            "units": units_of(about.get("units")),
        },
        "awaited": list(said.get("awaited", ())),
        "window_s": about.get("window_s"),
    }


def units_of(units: Sequence[str] | None) -> Plain | None:
    """Return the units of signals and response by name, from those of y and u."""
    if not units:
        return None
    y, u = units
    return {"r": y, "u": u, "y": y, "response": f"{u or 'u'}/{y or 'y'}"}


def _response(f: float, real: float, imag: float, real0: float, imag0: float, rr: float, ri: float, ii: float) -> Plain:
    middle, half = (rr + ii) / 2.0, math.hypot((rr - ii) / 2.0, ri)
    axes = [math.sqrt(CHI2_95 * max(variance, 0.0)) for variance in (middle + half, middle - half)]
    return {
        "frequency_hz": f,
        "real": real,
        "imag": imag,
        "nominal_real": real0,
        "nominal_imag": imag0,
        "ellipse": [*axes, 0.5 * math.atan2(2.0 * ri, rr - ii)],
    }


def _parameter(unit: str, name: str, value: float, std: float, nominal: float) -> Plain:
    low, high = value - TWO_SIDED * std, value + TWO_SIDED * std
    return {"name": name, "value": value, "std": std, "low": low, "high": high, "nominal": nominal, "unit": unit}


def transition(row: Mapping[str, Any]) -> Plain:
    """Return a row of the alarms' history."""
    document = row["document"]
    kept = {key: row[key] for key in ("asset", "number", "t", "alarm", "before", "after", "cause", "who")}
    return {**kept, "event": document.get("event", ""), "priority": document.get("priority")}


def live_id(asset: str, number: int) -> str:
    """Return the address of the diagnosis of a followed asset."""
    return f"{asset}@{number}"


def diagnosis_row(row: Mapping[str, Any]) -> Plain:
    """Return a diagnosis of a followed asset, without its document."""
    kept = {key: row[key] for key in ("asset", "number", "t", "grounds", "verdict", "summary", "onset")}
    return {"id": live_id(row["asset"], row["number"]), **kept, "recording": None}
