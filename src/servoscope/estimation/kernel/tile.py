"""Processes some samples in all lanes: together where none is disturbed, else one by one.

Templates, filled by `kernel.build` with sizes and traced steps. Arrays are (rows, lanes), one lane per asset; where all
lanes do the same, the loops over them become vector instructions.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from servoscope.core.arrays import FloatArray as Rows
from servoscope.core.jit import lane_view, stack_array
from servoscope.estimation.kernel.sample_steps import ARMED, BETWEEN, CUSUM_BATCH, MAX_PHYSICAL, MISSING, TILE, USED

# what the templates are filled with
_UNFILLED: Any = None
_advance_filters = _advance_filters_one = _update_alarm = _at = _begin_filters_one = _is_undisturbed = _UNFILLED
_filter_sample = _write_evaluation = _record_update_one = _reset_noise_one = _frequencies = _UNFILLED
_update_undisturbed = _try_undisturbed = _residual_rows = _reduce_cusums = _lanes = _update_estimate = _UNFILLED
_update_estimate_one = _update_cusums = _n = _store_residual = _begin_evaluation = _write_response = _UNFILLED
_gain_rows = _rows = _process_sample = _cusum_lanes = _learn_lane = _learn_lanes = _write_internal = _UNFILLED
_count_sample = _to = _update = _is_update = _watched = _accumulate_size = _width = _end_evaluation = _UNFILLED
_sums = _sums_at = _advance_shadow = _whiten_undisturbed = _shadow = _UNFILLED


def filter_sample(
    c: Rows, s: Rows, h: Rows, status: Rows, a: int, tile: Rows, i: int, due: bool, v: Rows, shadow: Rows
) -> None:
    """Pass any sample through the filters; after a gap, which a missing sample is, they begin in their steady state."""
    if not (
        abs(tile[i, a]) < MAX_PHYSICAL
        and abs(tile[i + TILE, a]) < MAX_PHYSICAL
        and abs(tile[i + 2 * TILE, a]) < MAX_PHYSICAL
    ):
        h[ARMED, a] = 0.0  # NaN is not below anything either
        status[0, a] = MISSING
    else:
        if tile[i + 3 * TILE, a] != 0.0 or h[ARMED, a] == 0.0:
            _begin_filters_one(a, c, s, h, tile, i)
        _advance_filters_one(a, c, s, h, status, v, shadow, tile, i, due)


def learn_steady(c: Rows, s: Rows, h: Rows, a: int, v: Rows, shadow: Rows, e: Rows, extra: Any) -> None:
    """Update with an estimator whose P stays at P_d."""
    _update_estimate_one(a, c, s, h, v, shadow, e)


def learn_general(c: Rows, s: Rows, h: Rows, a: int, v: Rows, shadow: Rows, e: Rows, extra: Any) -> None:
    """Update with any estimator: it changes theta and P itself."""
    theta = np.empty(_n)
    phi = np.empty(_n)
    z = np.empty(_n)
    K = np.empty(_n)
    P = np.empty((_n, _n))
    P_d = np.empty((_n, _n))
    k = stack_array(s, _gain_rows, _lanes)
    residual = v[0, a]
    for i in range(_n):
        theta[i], phi[i], z[i] = s[_to.theta + i, a], v[1 + i, a], v[_rows - _n + i, a]
        residual -= phi[i] * theta[i]
        for j in range(_n):
            P[i, j] = s[_to.P + _n * i + j, a]
            P_d[i, j] = c[_at.P_d + _n * i + j, a]
    refused = _update(theta, P, P_d, c[_at.R, a], c[_at.memory, a], v[0, a], phi, z, K, extra)
    for i in range(_n):
        s[_to.theta + i, a], k[i, a] = theta[i], K[i]
        for j in range(_n):
            s[_to.P + _n * i + j, a] = P[i, j]
    k[_n, a] = residual
    k[_n + 1, a] = refused
    _record_update_one(a, c, s, h, v, shadow, e, k)


def learn_lanes_steady(c: Rows, s: Rows, h: Rows, v: Rows, shadow: Rows, e: Rows) -> None:
    """Update all lanes with an estimator whose P stays at P_d."""
    for a in range(0, _lanes, _width):
        _update_estimate(a, c, s, h, v, shadow, e)


def learn_lanes_general(c: Rows, s: Rows, h: Rows, v: Rows, shadow: Rows, e: Rows) -> None:
    """Update one lane after the other with any estimator."""
    for a in range(_lanes):
        _learn_lane(c, s, h, a, v, shadow, e, c[0, 0:0])


def process_sample(
    c: Rows, s: Rows, h: Rows, tile: Rows, i: int, due: bool, v: Rows, shadow: Rows, e: Rows, status: Rows, extra: Rows
) -> None:
    """Process sample i of the tile in all lanes, whatever its status."""
    complete = True
    for a in range(0, _lanes, _width):
        complete &= _count_sample(a, h, tile, i)
    used = True
    if _lanes > 1 and complete:
        for a in range(0, _lanes, _width):
            used &= _advance_filters(a, c, s, h, status, v, shadow, tile, i, due)
    else:
        for a in range(_lanes):
            _filter_sample(c, s, h, status, a, tile, i, due, v, shadow)
        for a in range(0, _lanes, _width):
            used &= _is_update(a, status)
    if _lanes > 1 and used:
        _learn_lanes(c, s, h, v, shadow, e)
    else:
        for a in range(_lanes):
            if status[0, a] == USED:
                _learn_lane(c, s, h, a, v, shadow, e, extra)
            elif status[0, a] != BETWEEN:
                _reset_noise_one(a, s, h)


def process_undisturbed(
    c: Rows, s: Rows, h: Rows, tile: Rows, begin: int, end: int, e: Rows, w: Any, when: Any
) -> bool:
    """Process samples of the tile in all lanes if none is disturbed; return whether that is so."""
    for a in range(_lanes):
        e[0, a] = e[1, a] = 0.0
    undisturbed = True
    for a in range(0, _lanes, _width):
        _accumulate_size(a, e, tile, begin, end)
        undisturbed &= _is_undisturbed(a, h, e)
    if undisturbed:
        for a in range(0, _lanes, _width):  # one loop after the other: the state of each has room in registers
            if _shadow:
                _advance_shadow(a, c, s, w, tile, begin, end)
            _update_undisturbed(a, c, s, h, w, when, tile, begin, end)
            if _shadow:
                _whiten_undisturbed(a, c, s, h, w, begin, end)
    return undisturbed


def decline(c: Rows, s: Rows, h: Rows, tile: Rows, begin: int, end: int, e: Rows, w: Any, when: Any) -> bool:
    """Leave all to `process_sample`: axes may rest at any sample, some estimators have a P of their own."""
    return False


def process_samples(
    c: Rows, s: Rows, h: Rows, g: Rows, tile: Rows, begin: int, end: int, phase: int, stride: int, first: bool,
    last: bool, v: Rows, shadow: Rows, e: Rows, status: Rows, extra: Rows,
) -> None:  # fmt: skip
    """Process samples `begin` to `end` of the tile in all lanes; `first` and `last` begin and end an evaluation."""
    w = stack_array(c, _residual_rows, _lanes)
    when = stack_array(h, TILE, _lanes)
    if first:
        for a in range(0, _lanes, _width):
            _begin_evaluation(a, s, h)
    if not (stride == 1 and _try_undisturbed(c, s, h, tile, begin, end, e, w, when)):
        for i in range(begin, end):
            phase += 1
            _process_sample(c, s, h, tile, i, phase == stride, v, shadow, e, status, extra)
            if phase == stride:
                phase = 0
            if _watched and not _sums:
                for a in range(0, _lanes, _width):
                    _store_residual(a, c, s, h, status, e, w, when, i)
    if not _watched or (_sums and not last):
        return
    top = stack_array(c, TILE, _cusum_lanes)
    if _sums:  # the CUSUMs step once, with what the evaluation's samples sum up to
        w, begin, end = s[_sums_at:], 0, 1
    for i in range(begin, end):
        for a in range(_cusum_lanes):
            top[i, a] = 0.0
    if _lanes > 1:
        for j in range(0, _watched, CUSUM_BATCH):
            for a in range(0, _lanes, _width):
                _update_cusums(a, c[_at.tail + j :], g[j:], w, top, begin, end)
    else:
        _update_cusums(
            0,
            lane_view(c[_at.tail :], _cusum_lanes, 1),
            lane_view(g, _cusum_lanes, 1),
            lane_view(w, _cusum_lanes, 0),
            top,
            begin,
            end,
        )
        for i in range(begin, end):
            _reduce_cusums(0, lane_view(top, 1, 1), i)
    for a in range(0, _lanes, _width):
        if _sums:
            _end_evaluation(a, s, h, top)
        else:
            _update_alarm(a, s, h, top, when, begin, end)


def write_evaluations(c: Rows, s: Rows, h: Rows, q: Rows) -> None:
    """Write one complete evaluation of every lane to q."""
    for a in range(0, _lanes, _width):
        _write_evaluation(a, c, s, h, q)
    for f in range(_frequencies):
        for a in range(0, _lanes, _width):
            _write_response(a, c, s, f, q)


def write_internals(c: Rows, s: Rows, h: Rows, q: Rows) -> None:
    """Write the numbers that a diagnosis takes to q."""
    for a in range(0, _lanes, _width):
        _write_internal(a, s, h, q)


# each calls only those before it
TEMPLATES = (
    *(filter_sample, learn_steady, learn_general, learn_lanes_steady, learn_lanes_general, process_sample),
    *(process_undisturbed, decline, process_samples, write_evaluations, write_internals),
)
