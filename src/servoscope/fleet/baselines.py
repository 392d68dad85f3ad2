"""Where workers find the baseline of an asset, and the monitors made of them, once per process."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from servoscope.baseline.baseline import Baseline
from servoscope.core.errors import BaselineError
from servoscope.fleet.day_monitor import DayMonitor

MAX_CACHED_MONITORS = 4096  # per process; one takes some tens of milliseconds to make, and some tens of kilobytes


@dataclass(frozen=True)
class Baselines:
    """Baselines as they travel to workers."""

    source: Mapping[str, str] | Path  # JSON by name, that of "" for all others; or a folder that all workers see
    assets: int  # how many share the budget of false alarms
    window_s: float  # seconds of raw rows that a diagnosis covers

    @classmethod
    def from_source(
        cls, source: Baseline | Mapping[str, Baseline] | str | Path, assets: int, window_s: float
    ) -> Baselines:
        """Take one baseline for all, one per name, a file of one for all, or a folder with NAME.json for each.

        Raises BaselineError if there is none.
        """
        if isinstance(source, str | Path):
            if Path(source).is_dir():
                return cls(Path(source).absolute(), assets, window_s)
            source = Baseline.load(source)
        by_name = {"": source} if isinstance(source, Baseline) else source
        if not by_name:
            raise BaselineError("no baselines: give at least one")
        return cls(
            {name: baseline.model_dump_json(by_alias=True) for name, baseline in by_name.items()}, assets, window_s
        )

    def day_monitor(self, name: str) -> DayMonitor:
        """Return the monitor for an asset or group.

        Raises BaselineError if it has no baseline.
        """
        if isinstance(self.source, Path):
            return load_day_monitor(baseline_path(self.source, name), self.assets, self.window_s)
        text = self.source.get(name, self.source.get(""))
        if text is None:
            raise BaselineError(f"none is called {name}")
        return _parse_day_monitor(text, self.assets, self.window_s)

    def first(self) -> Baseline:
        """Return one of them, for what all have in common.

        Raises BaselineError if the folder holds none.
        """
        if not isinstance(self.source, Path):
            return Baseline.model_validate_json(next(iter(self.source.values())))
        file = min(self.source.glob("*.json"), default=None)
        if file is None:
            raise BaselineError(f"{self.source}: holds no baseline, a file NAME.json per asset or group")
        return Baseline.load(file)


def baseline_path(folder: str | Path, name: str) -> str:
    """Return the file of a baseline; characters that file systems may refuse are written as numbers."""
    plain = "".join(c if c.isalnum() or c in "-_." else f"%{ord(c):02X}" for c in name)
    return f"{folder}/{plain}.json"


@lru_cache(maxsize=MAX_CACHED_MONITORS)
def load_day_monitor(path: str, assets: int, window_s: float, point: str | None = None) -> DayMonitor:
    """Return the monitor of a baseline's file at an operating point, with its share of the budget.

    Raises BaselineError if the file is missing or damaged, or the operating point is.
    """
    baseline = Baseline.load(path)
    if baseline.others and point is None:
        raise BaselineError(f"{path}: has {', '.join(baseline.points)}: name the folders of the lake point=NAME")
    return DayMonitor((baseline.at(point) if baseline.others and point else baseline).shared(assets), window_s)


@lru_cache(maxsize=MAX_CACHED_MONITORS)
def _parse_day_monitor(text: str, assets: int, window_s: float) -> DayMonitor:
    return DayMonitor(Baseline.model_validate_json(text).shared(assets), window_s)
