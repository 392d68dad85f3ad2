"""Signals thinned to what a screen shows: extremes stay."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import sqlalchemy as sa

from servoscope.live.block import Block
from servoscope.plants import FloatArray
from servoscope.store import Store, tables

__all__ = ["chosen", "last_signals", "plain"]


def chosen(signals: Sequence[FloatArray], points: int) -> npt.NDArray[np.intp]:
    """Return which of N samples to show, so that at most about `points` are left and no extreme is lost.

    Each of equal parts shows where each signal is smallest and largest in it, in the order of time.
    """
    n = signals[0].size
    if n <= points:
        return np.arange(n, dtype=np.intp)
    parts = max(1, points // (2 * len(signals)))
    edges = np.linspace(0, n, parts + 1).astype(np.intp)[:-1]
    width = -(-n // parts)
    index = np.minimum(edges[:, None] + np.arange(width), n - 1)
    found = [np.zeros(1, dtype=np.intp), np.array([n - 1], dtype=np.intp)]
    for signal in signals:
        known = np.where(np.isfinite(signal), signal, np.nan)[index]
        for missing, pick in ((np.inf, np.argmin), (-np.inf, np.argmax)):
            at = pick(np.where(np.isnan(known), missing, known), axis=1)
            found.append(index[np.arange(parts), at])
    return np.unique(np.concatenate(found))


def plain(values: npt.ArrayLike) -> list[float | None]:
    """Return numbers ready for JSON: what is none becomes None."""
    return [x if math.isfinite(x) else None for x in np.asarray(values, dtype=np.float64).tolist()]


def last_signals(store: Store, asset: str, seconds: float, points: int) -> dict[str, Any]:
    """Return the last seconds of an asset from the samples that the store keeps."""
    table = tables.recent
    newest = sa.select(sa.func.max(table.c.sequence)).where(table.c.asset == asset)
    blocks: list[Block] = []
    query = sa.select(table).where(table.c.asset == asset).order_by(table.c.sequence.desc())
    sequence = next(iter(store.rows(newest)[0].values()))
    # as many as it takes, in steps: how long a block is, nobody has said
    limit = 16
    while sequence is not None:
        rows = store.rows(query.limit(limit))
        blocks = [Block.unpack(asset, row["sequence"], row["samples"]) for row in reversed(rows)]
        begins, ends = blocks[0].t[0], blocks[-1].t[-1]
        if ends - begins >= seconds or len(rows) < limit:
            break
        limit *= 4
    t, *signals = np.concatenate([block.signals for block in blocks], axis=1) if blocks else np.zeros((4, 0))
    within = t > t[-1] - seconds if t.size else np.zeros(0, dtype=np.bool_)
    t, signals = t[within], [signal[within] for signal in signals]
    at = chosen(signals, points)
    columns = {name: plain(signal[at]) for name, signal in zip("ruy", signals, strict=True)}
    return {"sequence": sequence, "samples": int(t.size), "t": plain(t[at]), **columns}
