"""Where workers find the baseline of an asset, and the followers made of them, once per process."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from servoscope.baseline import Baseline
from servoscope.errors import BaselineError
from servoscope.fleet.following import Follower

__all__ = ["Baselines", "baseline_file", "follower_of_file"]

KEPT = 4096  # followers per process; one takes some tens of milliseconds to make, and some tens of kilobytes


@dataclass(frozen=True)
class Baselines:
    """Baselines as they travel to workers; make them with `of`.

    Parameters
    ----------
    source
        JSON by name, that of "" for all others; or a folder that all workers see.
    assets
        How many share the budget of false alarms.
    window_s
        Seconds of raw rows that a diagnosis sees.
    """

    source: Mapping[str, str] | Path
    assets: int
    window_s: float

    @classmethod
    def of(cls, source: Baseline | Mapping[str, Baseline] | str | Path, assets: int, window_s: float) -> Baselines:
        """Take one baseline for all, one per name, a file of one for all, or a folder with NAME.json for each.

        Raises
        ------
        BaselineError
            If there is none.
        """
        if isinstance(source, str | Path):
            if Path(source).is_dir():
                return cls(Path(source).absolute(), assets, window_s)
            source = Baseline.load(source)
        by_name = {"": source} if isinstance(source, Baseline) else source
        if not by_name:
            raise BaselineError("no baselines: give at least one")
        return cls({name: one.model_dump_json(by_alias=True) for name, one in by_name.items()}, assets, window_s)

    def follower(self, name: str) -> Follower:
        """Return the follower for an asset or group.

        Raises
        ------
        BaselineError
            If it has no baseline.
        """
        if isinstance(self.source, Path):
            return follower_of_file(baseline_file(self.source, name), self.assets, self.window_s)
        text = self.source.get(name, self.source.get(""))
        if text is None:
            raise BaselineError(f"none is called {name}")
        return _follower(text, self.assets, self.window_s)

    def any(self) -> Baseline:
        """Return one of them, for what all have in common.

        Raises
        ------
        BaselineError
            If the folder holds none.
        """
        if not isinstance(self.source, Path):
            return Baseline.model_validate_json(next(iter(self.source.values())))
        first = next(iter(sorted(self.source.glob("*.json"))), None)
        if first is None:
            raise BaselineError(f"{self.source}: holds no baseline, a file NAME.json per asset or group")
        return Baseline.load(first)


def baseline_file(folder: str | Path, name: str) -> str:
    """Return the file of a baseline; characters that no file system likes are written as numbers."""
    plain = "".join(c if c.isalnum() or c in "-_." else f"%{ord(c):02X}" for c in name)
    return f"{folder}/{plain}.json"


@lru_cache(maxsize=KEPT)
def follower_of_file(path: str, assets: int, window_s: float) -> Follower:
    """Return the follower of a baseline's file, with its share of the budget.

    Raises
    ------
    BaselineError
        If the file is missing or damaged.
    """
    return Follower(Baseline.load(path).shared(assets), window_s)


@lru_cache(maxsize=KEPT)
def _follower(text: str, assets: int, window_s: float) -> Follower:
    return Follower(Baseline.model_validate_json(text).shared(assets), window_s)
