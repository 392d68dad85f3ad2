"""From the results of all items to a summary of the fleet: faulty assets, common causes, changes, failures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from servoscope.core.verdict import FOUND
from servoscope.fleet.common_cause import (
    ACCEPTANCE_PROBABILITY,
    PRIOR,
    Cause,
    Evidence,
    Prior,
    causes,
    fault_probability,
    log_fault_evidence,
)
from servoscope.fleet.rows import MICRO

Entry = Mapping[str, Any]
COMMON, FAILED = "common cause", "failed"
RATE = 0.05  # share of the named assets that is named in error, on average


@dataclass(frozen=True)
class AssetSummary:
    """One asset on the last day that tells how it is; the size is that of the first fault that the diagnosis names."""

    asset: str
    day: str
    groups: dict[str, str]  # what it belongs to: key -> group
    state: str  # healthy, fault, undetermined, common cause (the fault is that of a group), or failed
    before: str | None  # state on the day before
    probability: float  # of a fault of its own
    fault: str  # names of its faults
    parameter: str
    ratio: float | None  # of the parameter to its healthy value
    interval: tuple[float, float] | None  # 95 %
    sure: float | None  # probability of the diagnosis
    since_us: int | None  # onset [us], on the asset's clock
    said: str  # the diagnosis in a sentence, or why there is none


@dataclass(frozen=True)
class Fleet:
    """A fleet on its last day, and how it came there.

    Parameters
    ----------
    assets
        Each on its last day, the faulty ones first.
    causes, since
        Groups whose members may have changed together on their last day, the most probable first; and the first of
        the days in a row on which that was accepted.
    states
        By asset, then day.
    failed
        Items that could not be examined: (asset, day, error).
    unlearned
        By asset or group: why it has no baseline, or which healthy days could not be used.
    late
        By asset: rows of a stream that came too late and were left out.
    discovered
        Assets that have changed, the surest first; at most one in twenty of such names is wrong on average.
    """

    assets: tuple[AssetSummary, ...]
    causes: tuple[Cause, ...]
    since: tuple[str, ...]
    states: dict[str, dict[str, str]]
    failed: tuple[tuple[str, str, str], ...]
    unlearned: dict[str, str]
    late: dict[str, int]
    discovered: tuple[str, ...] = ()

    @property
    def accepted(self) -> tuple[Cause, ...]:
        """The common causes that are named."""
        return tuple(cause for cause in self.causes if cause.probability >= ACCEPTANCE_PROBABILITY)

    def count(self, state: str) -> int:
        """Return how many assets are in a state."""
        return sum(asset.state == state for asset in self.assets)

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values."""
        return asdict(self)


def summarise_fleet(
    entries: Sequence[Entry],
    groups: Mapping[str, Mapping[str, str]],
    unlearned: Mapping[str, str],
    prior: Prior = PRIOR,
    late: Mapping[str, int] | None = None,
) -> Fleet:
    """Summarise the results of items, which come by asset and day in order.

    `groups`: by asset: key -> group; `unlearned`, `late`: see `Fleet`.
    """
    by_day: dict[str, dict[str, Entry]] = {}
    by_asset: dict[str, dict[str, Entry]] = {}
    for entry in entries:
        by_day.setdefault(entry["day"], {})[entry["asset"]] = entry
        by_asset.setdefault(entry["asset"], {})[entry["day"]] = entry
    causes_by_day = {day: _common_causes(some.values(), groups, prior) for day, some in sorted(by_day.items())}
    states = {
        asset: _in_a_row(
            {day: _asset_state(entry, _accepted_cause(causes_by_day[day], asset)) for day, entry in days.items()}
        )
        for asset, days in by_asset.items()
    }
    last = [days[_last_known_day(states[asset])] for asset, days in by_asset.items()]
    now = _common_causes(last, groups, prior)
    assets = [_summarise_asset(entry, groups, now, states[entry["asset"]], prior) for entry in last]
    rank = ["fault", COMMON, "suspect", "undetermined", FAILED, "healthy"]
    assets.sort(key=lambda asset: (rank.index(asset.state), -asset.probability, asset.asset))
    failed = [(e["asset"], e["day"], str(e["error"])) for e in entries if e["status"] == FAILED]
    since = tuple(_first_accepted_day(cause, causes_by_day) for cause in now)
    discoveries = discover({e["asset"]: _parse_evidence(e) for e in last if "evidence" in e}, prior)
    return Fleet(
        tuple(assets), tuple(now), since, states, tuple(failed), dict(unlearned), dict(late or {}), discoveries
    )


def discover(evidence: Mapping[str, Evidence], prior: Prior = PRIOR, rate: float = RATE) -> tuple[str, ...]:
    """Return the assets that have changed at a false discovery rate, the surest first.

    The Bayes factor of a fault against none is an e-value: of a healthy asset it is 1 on average. With e-values of N
    assets those k are named whose smallest is at least N/(k rate), for the largest such k. That holds whatever the
    assets have in common: warm days, or one baseline (Wang and Ramdas, 2022, Journal of the Royal Statistical Society
    B, 84(3), proposition 2).
    """
    logs = {asset: log_fault_evidence(changes, prior) for asset, changes in evidence.items()}
    order = sorted(logs, key=lambda asset: (-logs[asset], asset))
    N = len(order)
    enough = [k for k, asset in enumerate(order, 1) if logs[asset] >= np.log(N / (k * rate))]
    return tuple(order[: max(enough, default=0)])


def _last_known_day(states: Mapping[str, str]) -> str:
    """Return the day that tells how an asset is: its last one, unless that shows nothing and there was a fault before.

    A file that is damaged, or of a machine that did not move, is no repair.
    """
    days = sorted(states, reverse=True)
    told = next((day for day in days if states[day] not in ("undetermined", FAILED)), days[0])
    return told if states[told] in ("fault", COMMON) else days[0]


def _common_causes(entries: Iterable[Entry], groups: Mapping[str, Mapping[str, str]], prior: Prior) -> list[Cause]:
    return causes({e["asset"]: _parse_evidence(e) for e in entries if "evidence" in e}, groups, prior)


def _parse_evidence(entry: Entry) -> Evidence:
    evidence = entry["evidence"]
    information = tuple(tuple(row) for row in evidence["information"])
    return Evidence(tuple(evidence["names"]), tuple(evidence["score"]), information)


def _accepted_cause(candidates: Sequence[Cause], asset: str) -> tuple[Cause, float] | None:
    """Return the accepted common cause of an asset, and the probability of a fault of its own besides."""
    for cause in candidates:
        if cause.probability >= ACCEPTANCE_PROBABILITY and asset in cause.members:
            return cause, cause.own[cause.members.index(asset)]
    return None


def _asset_state(entry: Entry, cause: tuple[Cause, float] | None) -> str:
    if entry["status"] == FAILED:
        return FAILED
    verdict = str(entry["diagnosis"]["verdict"])
    return COMMON if verdict == "fault" and cause is not None and cause[1] < ACCEPTANCE_PROBABILITY else verdict


def _in_a_row(states: Mapping[str, str]) -> dict[str, str]:
    """Return the states of days with a fault where one that was suspect came after another one."""
    told, before = dict(states), ""
    for day in sorted(states):
        if states[day] == "suspect" and before in FOUND:
            told[day] = "fault"
        before = states[day]
    return told


def _summarise_asset(
    entry: Entry, groups: Mapping[str, Mapping[str, str]], now: Sequence[Cause], days: Mapping[str, str], prior: Prior
) -> AssetSummary:
    cause = _accepted_cause(now, entry["asset"])
    diagnosis = entry.get("diagnosis", {})
    faults = diagnosis.get("faults") or ()
    best = next(iter(faults), None)
    onset = diagnosis.get("onset_s")
    own = diagnosis.get("probability") or 0.0 if diagnosis.get("verdict") == "fault" else 0.0  # of an arm
    if "evidence" in entry:
        own = cause[1] if cause is not None else fault_probability(_parse_evidence(entry), prior)
    before = [state for day, state in sorted(days.items()) if day < entry["day"]]
    return AssetSummary(
        asset=entry["asset"],
        day=entry["day"],
        groups=dict(groups.get(entry["asset"], {})),
        state=_asset_state(entry, cause),
        before=before[-1] if before else None,
        probability=own,
        fault=" + ".join(fault["name"] for fault in faults),
        parameter=best["parameter"] if best else "",
        ratio=best["ratio"] if best else None,
        interval=tuple(best["interval"]) if best else None,
        sure=diagnosis.get("probability"),
        since_us=entry["first_us"] + round(onset[1] * MICRO) if onset else None,
        said=diagnosis.get("summary") or str(entry["error"]),
    )


def _first_accepted_day(cause: Cause, by_day: Mapping[str, Sequence[Cause]]) -> str:
    """Return the first of the last days in a row on which a group's common cause was accepted; empty: none."""
    first = ""
    for day in sorted(by_day, reverse=True):
        same = [other for other in by_day[day] if (other.key, other.group) == (cause.key, cause.group)]
        if same and same[0].probability < ACCEPTANCE_PROBABILITY:
            break
        first = day if same else first
    return first
