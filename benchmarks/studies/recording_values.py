"""Figures of `recordings.py` that stand alone in sentences of documents."""

from __future__ import annotations

import re
from collections.abc import Mapping

from tables import Table


def values(tables: Mapping[str, Table]) -> dict[str, str]:
    """Return the figures that stand alone in sentences of documents."""
    rig, halves, pump_rows, qube_rows = (
        tables[title].rows for title in ("Reference rig", "EMPS: halves", "Pump-controlled EHA", "QUBE")
    )
    healthy = [row for row in rig if row[1] == "healthy"]
    single = [row for row in rig if row[1] != "healthy" and " and " not in row[1]]
    delays = sorted(float(row[2].split()[0]) for row in single if row[2])
    named = {name: sum(_is_named(row[at]) for row in single) for name, at in (("own", 3), ("foreign", 4))}
    found = {
        "rig.false": f"{sum(row[3].startswith('fault') for row in healthy)} of {len(healthy)}",
        "rig.false-foreign": f"{sum(row[4].startswith('fault') for row in healthy)} of {len(healthy)}",
        "rig.found": f"{len(delays)} of {len(single)}",
        "rig.delays": f"{delays[0]:.2f} to {delays[-1]:.1f} s",
        "rig.named": f"{named['own']} of {len(single)}",
        "rig.named-foreign": f"{named['foreign']} of {len(single)}",
        "rig.pair": next(row[3] for row in rig if " and " in row[1]),
        "emps.false": f"{sum(row[1].startswith('fault') for row in halves)} of {len(halves)}",
        "pump.false": f"{sum(row[2].startswith('fault') for row in pump_rows if row[0] == '1')} of 1",
        "pump.found": f"{sum(row[2].startswith('fault') for row in pump_rows if row[0] != '1')} of 4",
        "pump.named": f"{sum(_is_named(row[2]) for row in pump_rows if row[0] != '1')} of 4",
        "qube.false": f"{sum(row[2].startswith('fault') for row in qube_rows)} of {len(qube_rows)}",
    }
    for name, *_, off in tables["EMPS: parameters"].rows:
        found[f"emps.{name}"] = off.lstrip("+-")
    for machine, truth, late, best, _ in tables["Injected changes"].rows:
        found[f"{machine.split(',')[0].lower()}.{truth.split()[0]}-injected"] = (
            f"{best} after {late}" if late else "not found"
        )
    for machine, truth, late, _, onset in tables["Injected changes"].rows:
        if late:
            low, likeliest, high = onset.split()
            key = f"{machine.split(',')[0].lower()}.{truth.split()[0]}-onset"
            found[key] = f"{likeliest} s ({low} to {high} s)"
    healthy_ratios = [row[2] for row in halves] + [row[3] for row in pump_rows if row[0] == "1"]
    ratios = sorted(float(text) for text in [*healthy_ratios, *(row[3] for row in qube_rows)])
    found["healthy-margin"] = f"{100.0 * ratios[0]:.0f} to {100.0 * ratios[-1]:.0f} %"
    for machine, title in (("qube", "QUBE"), ("emps-half", "EMPS: halves")):
        promised = re.findall(r"(\w+) (\d+)%", tables[title].note.partition("Promised")[2])
        found |= {f"{machine}.promised.{name}": f"{change} %" for name, change in promised}
    return found


def _is_named(text: str) -> bool:
    return text not in ("healthy", "undetermined") and not text.startswith(("fault", "none"))
