"""The recursion of `servoscope.estimation.window_features`, compiled: several assets, one after the other."""

from __future__ import annotations

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray, IntArray
from servoscope.core.jit.loops import kernel
from servoscope.estimation.window_state import HEADER, MAX_PHYSICAL, ROW_HEADER


@kernel
def _load_bands(
    b_a: FloatArray,
    s: FloatArray,
    powers: int,
    bands: int,
    weights: FloatArray,
    filters: FloatArray,
    square: FloatArray,
) -> None:
    # band-passes of u, then those of e, side by side; the last row of the weights is 1 for those of u
    for i in range(2 * bands):
        j, band = i // bands, i % bands
        weights[3, i] = 1.0 - j
        for row in range(3):
            weights[row, i] = b_a[row * bands + band]
            square[row, i] = s[powers + (3 * j + row) * bands + band]
        for row in range(4):
            filters[row, i] = s[HEADER + 4 * (2 * band + j) + row]


@kernel
def _store_powers(s: FloatArray, powers: int, bands: int, square: FloatArray) -> None:
    for i in range(2 * bands):
        for row in range(3):
            s[powers + (3 * (i // bands) + row) * bands + i % bands] = square[row, i]


@kernel
def _close_window(
    s: FloatArray,
    begin: int,
    levels: int,
    sums: int,
    span: float,
    asset: int,
    sample: float,
    rows: int,
    out: FloatArray,
    lane: IntArray,
) -> int:
    # a window of the next level is two of this one; all begin anew where a span ends
    s[2] = 0.0
    s[3] += 1.0
    for level in range(levels):
        at = begin + level * (1 + sums)
        if level:
            for i in range(sums):
                s[at + 1 + i] += s[begin + 1 + i]
        s[at] += 1.0
        if s[at] >= 2**level:
            lane[rows], out[rows, 0], out[rows, 1], out[rows, 2] = asset, sample, level, s[4]
            for i in range(sums):
                out[rows, ROW_HEADER + i] = s[at + 1 + i]
            rows += 1
            if level:
                for i in range(sums + 1):
                    s[at + i] = 0.0
    for i in range(sums + 1):
        s[begin + i] = 0.0
    if s[3] >= span:
        s[3] = 0.0
        s[4] += 1.0
        s[begin : begin + levels * (1 + sums)] = 0.0
    return rows


@kernel
def accumulate_windows(
    table: FloatArray,
    states: FloatArray,
    begins: IntArray,
    R: FloatArray,
    U: FloatArray,
    Y: FloatArray,
    restarts: BoolArray,
    out: FloatArray,
    lane: IntArray,
) -> int:
    """Feed a block of samples of several assets; write a row per window that ended, and return how many these are.

    See `WindowLanes.run` for the arguments; `out`, `lane`: rows of windows and whose they are.
    """
    rows, lanes = 0, 2 * int(table[:, 5].max())
    weights, filters, square = np.zeros((4, lanes)), np.zeros((4, lanes)), np.zeros((4, lanes))
    for asset in range(len(table)):
        c, s = table[asset], states[asset, begins[asset] :]
        r, u, y, restart = R[asset], U[asset], Y[asset], restarts[asset]
        window, levels, span, settling, edges, bands = c[0], int(c[1]), c[2], c[3], int(c[4]), int(c[5])
        if bands == 0:
            continue
        resting, rate, smoothing = c[6], c[7], c[8]
        bins, begin = 3 * (edges + 1), HEADER + 8 * bands
        sums, powers = 3 * bins + 3 * (2 * bands + 1), begin + 1 + 3 * bins
        _load_bands(c[9 + edges :], s, powers, bands, weights, filters, square)
        armed, sample, speed, before, moving = s[0], s[1], s[6], s[5], int(s[7])
        for k in range(len(r)):
            sample += 1.0
            if not (abs(r[k]) < MAX_PHYSICAL and abs(u[k]) < MAX_PHYSICAL and abs(y[k]) < MAX_PHYSICAL):
                armed = 0.0
                continue
            if restart[k] or armed == 0.0:
                armed, before, speed, moving, s[2] = 1.0, r[k], 0.0, 0, 0.0
                # a band-pass has forgotten a constant: it starts where a signal has always been what it is now
                for i in range(2 * bands):
                    filters[0, i] = filters[1, i] = -weights[0, i] * (u[k] if i < bands else r[k] - y[k])
                    filters[2, i] = filters[3, i] = 0.0
                square[:] = 0.0
                s[begin : begin + levels * (1 + sums)] = 0.0
            speed += smoothing * ((r[k] - before) * rate - speed)
            before = r[k]
            motion = 2
            if speed > resting:
                motion = 0
            elif speed < -resting:
                motion = 1
            moving = moving + 4 if moving & 3 == motion else motion
            since, place = float(moving >> 2), motion * (edges + 1)
            for edge in range(edges):
                if since >= c[9 + edge]:
                    place += 1
            settled = sample > settling
            row, error = motion if settled else 3, r[k] - y[k]
            for i in range(lanes):  # u or e, twice through a band-pass
                b, a, a_last = weights[0, i], weights[1, i], weights[2, i]
                value = u[k] if weights[3, i] > 0.0 else error
                first = b * value + filters[0, i]
                filters[0, i] = filters[1, i] - a * first
                filters[1, i] = -b * value - a_last * first
                passed = b * first + filters[2, i]
                filters[2, i] = filters[3, i] - a * passed
                filters[3, i] = -b * first - a_last * passed
                square[row, i] += passed * passed
            if not settled:
                continue
            s[begin + 1 + bins + place] += u[k]
            s[begin + 1 + 2 * bins + place] += r[k] - y[k]
            s[begin + 1 + place] += 1.0
            s[powers + 6 * bands + motion] += speed * speed
            s[2] += 1.0
            if s[2] < window:
                continue
            _store_powers(s, powers, bands, square)
            square[:] = 0.0
            rows = _close_window(s, begin, levels, sums, span, asset, sample, rows, out, lane)
        _store_powers(s, powers, bands, square)
        for i in range(2 * bands):
            for row in range(4):
                s[HEADER + 4 * (2 * (i % bands) + i // bands) + row] = filters[row, i]
        s[0], s[1], s[5], s[6], s[7] = armed, sample, before, speed, moving
    return rows
