"""The two pieces of work that an engine hands out: learn one baseline, examine one item. They never raise.

Both are plain data that travels to other processes and machines; a task that fails says so in its result, by name.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from servoscope.baseline import Baseline
from servoscope.errors import NotEnoughError, ServoscopeError
from servoscope.fleet.baselines import follower_of_file
from servoscope.fleet.following import Evaluated, Follower, Memory, State
from servoscope.fleet.lake import Item
from servoscope.fleet.reading import blocks
from servoscope.fleet.rows import MICRO, Rows
from servoscope.loop import Columns, Loop
from servoscope.output import atomic_write, make_folder
from servoscope.recording import Recording, clean

__all__ = ["Examine", "Learn", "columns_of", "examined", "traces"]


@dataclass(frozen=True)
class Learn:
    """Learn what healthy looks like from some items, and write it to a file.

    Parameters
    ----------
    name
        Of the asset, or of the group of assets.
    items
        Healthy ones.
    loop
        Settings, with the columns.
    output
        The baseline's file.
    most_s
        Seconds of each item that are learned from.
    """

    name: str
    items: tuple[Item, ...]
    loop: Loop
    output: str
    most_s: float

    @property
    def key(self) -> str:
        """What a result calls it."""
        return self.name

    def run(self) -> dict[str, Any]:
        """Learn; items that cannot be used are named and left out."""
        from servoscope.points import learn

        unused: dict[str, str] = {}
        recordings: list[Recording] = []
        for item in self.items:
            try:
                recordings.append(self._read(item))
            except Exception as error:  # whatever is wrong with one item must not cost the others
                unused[f"{item.asset} {item.day}"] = _told(error)
        try:
            if not recordings:
                raise NotEnoughError("; ".join(f"{name}: {why}" for name, why in unused.items()))
            learn(self.loop, recordings).save(self.output)
        except Exception as error:
            return {"name": self.name, "error": _told(error), "unused": unused}
        return {"name": self.name, "error": None, "unused": unused}

    def _read(self, item: Item) -> Recording:
        parts: list[Rows] = []
        for rows in blocks(item.files, self.loop.columns):
            parts.append(rows)
            if rows.t_us[-1] - parts[0].t_us[0] > self.most_s * MICRO:
                break
        rows = Rows.joined(parts)
        if not len(rows):
            raise NotEnoughError("holds no rows")
        rows = rows.between(int(rows.t_us[0]) - 1, int(rows.t_us[0] + self.most_s * MICRO))
        return clean(
            (rows.t_us - rows.t_us[0]) / MICRO,
            rows.r,
            rows.u,
            rows.y,
            name=f"{item.asset} {item.day}",
            sample_rate=self.loop.sample_rate,
            limits=self.loop.input_limits,
        )


@dataclass(frozen=True)
class Examine:
    """Follow one item and diagnose it; write its trace.

    Parameters
    ----------
    item
        The asset's day.
    baseline
        File of the baseline; None: there is none, because of `why`.
    why
        Why there is none.
    assets
        How many assets share the budget of false alarms.
    columns
        Where the signals stand; None: where the baseline's loop says.
    window_s
        Seconds of raw rows that a diagnosis sees.
    trace
        Parquet file of the trace; None: it is not written.
    """

    item: Item
    baseline: str | None
    why: str
    assets: int
    columns: Columns | None
    window_s: float
    trace: str | None

    @property
    def key(self) -> tuple[str, str]:
        """What a result calls it."""
        return self.item.key

    def run(self) -> dict[str, Any]:
        """Return what was found, as plain values."""
        try:
            if self.baseline is None:
                raise ServoscopeError(f"no baseline: {self.why}")
            one = follower_of_file(self.baseline, self.assets, self.window_s)
            state, parts = _followed(one, blocks(self.item.files, columns_of(one.baseline, self.columns)))
            if self.trace is not None and parts:
                make_folder(Path(self.trace).parent)
                atomic_write(self.trace, _parquet(parts))
            found = json.loads(json.dumps(examined(one, state), allow_nan=False))
        except Exception as error:  # garbage in one item must not cost another
            found = {"status": "failed", "error": _told(error)}
        return {"asset": self.item.asset, "day": self.item.day, "stamp": self.item.stamp, **found}


def columns_of(baseline: Baseline, columns: Columns | None) -> Columns:
    """Return where the signals stand."""
    return columns if columns is not None else baseline.loop.columns


def _followed(one: Follower, source: Iterable[Rows]) -> tuple[State, list[Evaluated]]:
    state, history, parts = one.start(), Memory(), []
    for rows in source:
        history.add(rows)
        state, evaluated = one.advance(state, rows, history)
        history.forget(one.needed(state))
        parts.append(evaluated)
    return one.finish(state, history), parts


def examined(one: Follower, state: State) -> dict[str, Any]:
    """Return what is known of a day that is over, as plain values."""
    if state.said is None:
        return {"status": "failed", "error": "holds no rows"}
    if (error := state.said.get("error")) is not None:
        return {"status": "failed", "error": error}
    counts = {name: getattr(state, name) for name in ("samples", "repeats", "missing", "gaps", "evaluations", "peak")}
    times = {"first_us": state.first_us, "last_us": state.last_us, "alarm_us": state.alarm_us}
    return {"status": "examined", "error": None, "baseline": one.baseline.hash, **counts, **times, **state.said}


def traces(parts: Iterable[Evaluated]) -> dict[str, Any]:
    """Return the columns of a trace: time_us, theta_0 ..., statistic, threshold, level."""
    parts = list(parts)
    theta = np.concatenate([part.theta for part in parts])
    columns = {"time_us": np.concatenate([part.t_us for part in parts])}
    columns |= {f"theta_{i}": theta[:, i] for i in range(theta.shape[1])}
    return columns | {
        name: np.concatenate([getattr(part, name) for part in parts]) for name in ("statistic", "threshold", "level")
    }


def _parquet(parts: list[Evaluated]) -> bytes:
    import pyarrow as pa
    import pyarrow.parquet as pq

    sink = io.BytesIO()
    pq.write_table(pa.table(traces(parts)), sink)
    return sink.getvalue()


def _told(error: Exception) -> str:
    text = " ".join(str(error).split())
    return text if isinstance(error, ServoscopeError) else f"{type(error).__name__}: {text[:200]}"
