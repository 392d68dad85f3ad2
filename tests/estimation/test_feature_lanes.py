"""Windows of several assets in one call: the bits of each alone, whatever the layouts, gaps and blocks."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from servoscope.estimation.window_features import FeatureLayout, Window, WindowFeatures, WindowLanes

LAYOUT = FeatureLayout(
    sample_rate=100.0,
    window=70,
    levels=3,
    span=4,
    settling=20,
    rest_speed=0.2,
    edges_s=(0.1, 0.4),
    bands_hz=(0.5, 2.0, 5.0, 12.0, 30.0),
    floors=(1e-12, 1e-12),
)
# more lanes than a vector has, fewer, and one asset without features
LAYOUTS = (
    LAYOUT,
    LAYOUT.model_copy(update={"bands_hz": tuple(np.geomspace(0.5, 40.0, 12).tolist()), "window": 33, "levels": 1}),
    None,
    LAYOUT.model_copy(update={"bands_hz": (1.0, 30.0), "edges_s": (), "settling": 0, "span": 2}),
)
BLOCKS = 0, 1, 2, 150, 151, 333, 600
COLUMN = 5  # of the rows, where the first state begins


def signals() -> list[Any]:
    rng, t = np.random.default_rng(3), np.arange(BLOCKS[-1]) / 100.0
    r, u, y = (np.sin(3.0 * t) + level * rng.normal(size=(len(LAYOUTS), t.size)) for level in (0.0, 0.3, 0.01))
    y[0, 200], u[1, 340:343], r[3, 50] = np.nan, np.inf, 1e200
    restart = np.zeros(r.shape, dtype=np.bool_)
    restart[1, 100] = restart[3, 400] = True
    return [r, u, y, restart]


def numbers(window: Window) -> bytes:
    return np.concatenate([[window.end, window.level, window.span], window.features, window.motion]).tobytes()


def together() -> tuple[Any, list[list[bytes]]]:
    """Return the rows at the end, and what each asset's windows hold."""
    runners = [None if layout is None else WindowFeatures(layout) for layout in LAYOUTS]
    begins = COLUMN + np.arange(len(runners))
    rows = np.full((len(runners), 1000), 7.0)
    for row, begin, one in zip(rows, begins, runners, strict=True):
        if one is not None:
            row[begin : begin + one.size] = one.start()
    lanes, found = WindowLanes(runners, begins), [list[bytes]() for _ in runners]
    for a, b in pairwise(BLOCKS):
        for asset, window in lanes.run(rows, *(x[:, a:b] for x in signals())):
            found[asset].append(numbers(window))
    return rows, found


def test_each_asset_has_the_bits_that_it_has_alone() -> None:
    rows, found = together()
    for i, layout in enumerate(LAYOUTS):
        untouched = np.ones(rows.shape[1], dtype=np.bool_)
        if layout is not None:
            one = WindowFeatures(layout)
            state = one.start()
            alone = [numbers(window) for window in one.run(state, *(x[i] for x in signals()))]
            assert alone and found[i] == alone
            own = slice(COLUMN + i, COLUMN + i + one.size)
            assert rows[i, own].tobytes() == state.tobytes()
            untouched[own] = False
        assert (rows[i, untouched] == 7.0).all()  # it writes nowhere else
