"""The metrics of each asset as text for Prometheus: its client takes ten times as long, and a service has thousands."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple

from servoscope.service.assets.asset import Asset
from servoscope.service.assets.status import asset_verdict
from servoscope.signals import quality

STREAM_COUNTERS = {
    "blocks": "Blocks that were counted",
    "samples": "Samples that were counted",
    "lost": "Blocks that never came",
    "repeated": "Blocks that came once more and were left out",
    "late": "Blocks left out because their time stamps lie behind what was counted",
    "future": "Blocks left out because their time stamps lie ahead of the service's clock",
}


class AssetSeries(NamedTuple):
    """The series of all assets, and how many alarms of each name, priority and state are not normal."""

    text: str
    alarms: Counter[tuple[str, str, str]]


def write_asset_series(assets: Mapping[str, Asset]) -> AssetSeries:
    """Write down the metrics of assets, from any thread; those that have not begun have only a reception."""
    counts: dict[str, list[str]] = {key: [] for key in STREAM_COUNTERS}
    last, verdicts, receptions, alarms = list[str](), list[str](), list[str](), Counter[tuple[str, str, str]]()
    for name, asset in assets.items():
        label, reception = f'asset="{escape_label(name)}"', asset.reception
        of_source = f'source="{escape_label(asset.source)}",state="{reception.state}"'
        receptions.append(f"servoscope_reception{{{label},{of_source}}} 1.0")
        if (visible := asset.visible_record) is None:
            continue
        state, position = visible
        for key, lines in counts.items():
            lines.append(f"servoscope_{key}_total{{{label}}} {float(getattr(position, key))}")
        if position.blocks:
            last.append(f"servoscope_last_sample_time_seconds{{{label}}} {position.t}")
        verdict = asset_verdict(state.examination, quality.active_findings(state.quality), reception)
        verdicts.append(f'servoscope_verdict{{{label},verdict="{verdict}"}} 1.0')
        alarms.update(asset.standing_alarms(state))
    families = [(f"{key}_total", "counter", STREAM_COUNTERS[key], lines) for key, lines in counts.items()]
    families += [
        ("last_sample_time_seconds", "gauge", "Time of the last sample", last),
        ("reception", "gauge", "1 for how an asset's samples come in", receptions),
        ("verdict", "gauge", "1 for the verdict that holds", verdicts),
    ]
    return AssetSeries("".join(_family_lines(*family) for family in families), alarms)


def escape_label(value: str) -> str:
    """Return a value of a label as Prometheus reads it."""
    return value.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")


def _family_lines(name: str, kind: str, words: str, lines: list[str]) -> str:
    return "\n".join([f"# HELP servoscope_{name} {words}", f"# TYPE servoscope_{name} {kind}", *lines, ""])
