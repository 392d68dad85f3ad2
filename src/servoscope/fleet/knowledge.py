"""From the results of all items to what the fleet knows: who is ill, what is common, what changed, what failed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from servoscope.fleet.common import ACCEPTED, PRIOR, Cause, Prior, causes, individual
from servoscope.fleet.evidence import Evidence
from servoscope.fleet.rows import MICRO

__all__ = ["Fleet", "Known", "known"]

Entry = Mapping[str, Any]
COMMON, FAILED = "common cause", "failed"


@dataclass(frozen=True)
class Known:
    """What is known of one asset on its last day.

    Parameters
    ----------
    asset, day, groups
        Which it is.
    state
        ``healthy``, ``fault``, ``undetermined``, ``common cause`` where the group's explains it, or ``failed``.
    before
        The same on the day before; None: there was none.
    probability
        Of a fault of its own.
    fault, parameter, ratio, interval, sure
        What the diagnosis names, if it does: fault, parameter, ratio to healthy, its 95 % interval, probability.
    since_us
        Onset [us], on the asset's clock.
    said
        The diagnosis in a sentence, or why there is none.
    """

    asset: str
    day: str
    groups: dict[str, str]
    state: str
    before: str | None
    probability: float
    fault: str
    parameter: str
    ratio: float | None
    interval: tuple[float, float] | None
    sure: float | None
    since_us: int | None
    said: str


@dataclass(frozen=True)
class Fleet:
    """What is known of a fleet.

    Parameters
    ----------
    assets
        Each on its last day, the ill ones first.
    causes
        Groups whose members may have changed together on their last day, the most probable first; `since` is the
        first of the days in a row on which it was accepted.
    states
        By asset, then day: the state, in the order of days.
    failed
        Items that cost themselves: (asset, day, why).
    unlearned
        By asset or group: why it has no baseline, or which healthy days could not be used.
    late
        By asset: rows of a stream that came too late and were left out.
    """

    assets: tuple[Known, ...]
    causes: tuple[Cause, ...]
    since: tuple[str, ...]
    states: dict[str, dict[str, str]]
    failed: tuple[tuple[str, str, str], ...]
    unlearned: dict[str, str]
    late: dict[str, int]

    @property
    def accepted(self) -> tuple[Cause, ...]:
        """The common causes that are named."""
        return tuple(cause for cause in self.causes if cause.probability >= ACCEPTED)

    def count(self, state: str) -> int:
        """Return how many assets are in a state."""
        return sum(one.state == state for one in self.assets)

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values."""
        return asdict(self)


def known(
    entries: Sequence[Entry],
    groups: Mapping[str, Mapping[str, str]],
    unlearned: Mapping[str, str],
    prior: Prior = PRIOR,
    late: Mapping[str, int] | None = None,
) -> Fleet:
    """Put together what a fleet's results say.

    Parameters
    ----------
    entries
        Results of items, by asset and day in order.
    groups
        By asset: key -> group.
    unlearned
        What could not be learned.
    prior
        What is assumed before looking.
    late
        By asset: rows of a stream that came too late.
    """
    by_day: dict[str, dict[str, Entry]] = {}
    by_asset: dict[str, dict[str, Entry]] = {}
    for entry in entries:
        by_day.setdefault(entry["day"], {})[entry["asset"]] = entry
        by_asset.setdefault(entry["asset"], {})[entry["day"]] = entry
    found = {day: _causes(list(some.values()), groups, prior) for day, some in sorted(by_day.items())}
    states = {
        asset: {day: _state(entry, _cause(found[day], asset)) for day, entry in days.items()}
        for asset, days in by_asset.items()
    }
    last = [max(days.items())[1] for days in by_asset.values()]
    now = _causes(last, groups, prior)
    assets = [_known(entry, groups, now, states[entry["asset"]], prior) for entry in last]
    rank = ["fault", COMMON, "undetermined", FAILED, "healthy"]
    assets.sort(key=lambda one: (rank.index(one.state), -one.probability, one.asset))
    failed = [(e["asset"], e["day"], str(e["error"])) for e in entries if e["status"] == FAILED]
    since = tuple(_since(cause, found) for cause in now)
    return Fleet(tuple(assets), tuple(now), since, states, tuple(failed), dict(unlearned), dict(late or {}))


def _causes(entries: Sequence[Entry], groups: Mapping[str, Mapping[str, str]], prior: Prior) -> list[Cause]:
    return causes({e["asset"]: _evidence(e) for e in entries if "evidence" in e}, groups, prior)


def _evidence(entry: Entry) -> Evidence:
    told = entry["evidence"]
    rows = tuple(tuple(row) for row in told["information"])
    return Evidence(tuple(told["names"]), tuple(told["score"]), rows)


def _cause(found: Sequence[Cause], asset: str) -> tuple[Cause, float] | None:
    """Return the accepted common cause of an asset, and the probability of a fault of its own besides."""
    for cause in found:
        if cause.probability >= ACCEPTED and asset in cause.members:
            return cause, cause.own[cause.members.index(asset)]
    return None


def _state(entry: Entry, cause: tuple[Cause, float] | None) -> str:
    if entry["status"] == FAILED:
        return FAILED
    verdict = str(entry["diagnosis"]["verdict"])
    return COMMON if verdict == "fault" and cause is not None and cause[1] < ACCEPTED else verdict


def _known(
    entry: Entry, groups: Mapping[str, Mapping[str, str]], now: Sequence[Cause], days: Mapping[str, str], prior: Prior
) -> Known:
    cause = _cause(now, entry["asset"])
    said = entry.get("diagnosis", {})
    best = next(iter(said.get("faults") or ()), None)
    onset = said.get("onset_s")
    own = 0.0
    if "evidence" in entry:
        own = cause[1] if cause is not None else individual(_evidence(entry), prior)
    before = [state for day, state in sorted(days.items()) if day < entry["day"]]
    return Known(
        asset=entry["asset"],
        day=entry["day"],
        groups=dict(groups.get(entry["asset"], {})),
        state=_state(entry, cause),
        before=before[-1] if before else None,
        probability=own,
        fault=" + ".join(fault["name"] for fault in said.get("faults") or ()),
        parameter=best["parameter"] if best else "",
        ratio=best["ratio"] if best else None,
        interval=tuple(best["interval"]) if best else None,
        sure=said.get("probability"),
        since_us=entry["first_us"] + round(onset[1] * MICRO) if onset else None,
        said=said.get("summary") or str(entry["error"]),
    )


def _since(cause: Cause, found: Mapping[str, Sequence[Cause]]) -> str:
    """Return the first of the last days in a row on which a group's common cause was accepted; empty: none."""
    first = ""
    for day in sorted(found, reverse=True):
        same = [c for c in found[day] if (c.key, c.group) == (cause.key, cause.group)]
        if not same:
            continue
        if same[0].probability < ACCEPTED:
            break
        first = day
    return first
