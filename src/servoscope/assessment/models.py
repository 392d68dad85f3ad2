"""Competing models of the same record: a linear loop, a sinusoid from outside, stick-slip, a dead band, a clip.

Each is y(k) = a_1 y(k-1) + ... + b_1 x(k-1-d) + b_2 x(k-2-d) + c, where x is what the model makes of u. The one whose
innovations have the smallest variance has the largest likelihood: ln L = -N/2 ln(sigma^2) + const.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numpy.polynomial import polynomial

from servoscope.core.arrays import FloatArray

ORDER = 6  # lags of y: enough for a process with noise of its own
INPUTS = 2  # lags of x
MAX_DELAYS = 15  # tried with the linear loop
SIZES = tuple(np.geomspace(0.06, 0.95, 16).tolist())  # S over the range of u
JUMPS = (0.2, 0.5, 0.8, 1.0)  # J over S
PHASES = (-0.8, -0.4, 0.0, 0.4, 0.8)  # first position less u(0), over f_S
SIZES_OF_BAND = tuple(np.geomspace(0.06, 0.95, 15).tolist())  # of a dead band over the range of u
KEPT, REFINED = 8, 4  # points that are fitted at all scales, and searched around
STEPS, SEARCH_STEP = 16, 0.12  # of the search around a point: tries, and their standard deviation in the first round
CLIPS = (0.7, 0.85, 0.95)  # quantiles of u from which on the actuator would not follow


class ModelFit(NamedTuple):
    """A model fitted to a record."""

    variance: float  # of the innovations
    coefficients: FloatArray  # a_1 .. a_3, b_1, b_2, c, then cosine and sine if there are some
    delay: int  # d [samples]
    size: float = 0.0  # S, dead band or limit [units of u]
    jump: float = 0.0  # J [units of u]


class ModelComparison(NamedTuple):
    """The best fit of each kind of model to a record of M samples."""

    alone: ModelFit  # y from its own past, without u
    linear: ModelFit
    stick: ModelFit
    dead_band: ModelFit
    clip: ModelFit
    outside: ModelFit
    samples: int

    def gain(self, fit: ModelFit, parameters: int) -> float:
        """Return ln L of a model above the linear loop's; `parameters` parameters cost ln(M)/2 each (Schwarz, 1978)."""
        return self.between(self.linear, fit) - 0.5 * parameters * float(np.log(self.samples))

    def between(self, fit: ModelFit, better: ModelFit) -> float:
        """Return ln L of a model above another's."""
        return float(0.5 * self.samples * np.log(fit.variance / better.variance))


def stick_slip(u: FloatArray, static: FloatArray, kinetic: FloatArray, first: FloatArray) -> FloatArray:
    """Return the position of a sticking valve for each pair of parameters, shape (lanes, N).

    The valve moves to u -+ f_D once |u - x| exceeds f_S; S = f_S + f_D and J = f_S - f_D (He et al., 2007). f_S = f_D
    is a dead band of the width 2 f_S.
    """
    x = first
    out = np.empty((static.size, u.size))
    for k, now in enumerate(u.tolist()):
        off = now - x
        moves = np.abs(off) > static
        if moves.any():
            x = np.where(moves, now - np.sign(off) * kinetic, x)
        out[:, k] = x
    return out


def compare_models(u: FloatArray, y: FloatArray, period: float, scales: Sequence[int] = (1,)) -> list[ModelComparison]:
    """Fit all models to equidistant samples of u and y, shape (N,); period of the oscillation [samples].

    `scales`: how many neighbours are averaged before the fit, once per result: noise hides in one step what is plain
    over several. Stick band and jump are searched on a grid, and then around its best points.
    """
    low, high = np.quantile(u, [0.01, 0.99])
    span = max(float(high - low), 1e-12)
    bands = np.array([(s * span, 0.0, 0.0) for s in SIZES_OF_BAND])
    grid = np.concatenate([_search_slips(u, y, period, scales, span), bands])
    lanes = _positions(u, grid)
    edges = np.quantile(u, [*CLIPS, *(1.0 - q for q in CLIPS)])
    clipped = [np.minimum(u, edge) if i < len(CLIPS) else np.maximum(u, edge) for i, edge in enumerate(edges)]
    plain = np.stack([u, *clipped])
    return [
        _compare(thin(lanes, scale), thin(plain, scale), thin(y, scale), period / scale, grid, edges)
        for scale in scales
    ]


def _search_slips(u: FloatArray, y: FloatArray, period: float, scales: Sequence[int], span: float) -> FloatArray:
    """Return the likeliest S, J/S and first positions, shape (K, 3): on a grid, then around its best points."""
    grid = np.array([(s * span, j, phase) for s in SIZES for j in JUMPS for phase in PHASES])
    coarse = scales[min(1, len(scales) - 1)]  # where the likelihood is smooth, and cheap
    kept = []
    for scale, rounds in ((coarse, 2), (scales[0], 3)):
        target = thin(y, scale)
        delays = _delays(thin(u, scale), target, period / scale)
        variances = _variances(u, grid, scale, target, delays)
        steps = np.random.default_rng(0).standard_normal((STEPS, 3)) * SEARCH_STEP
        for _ in range(rounds):
            best = grid[np.argsort(variances)[:REFINED]]
            near = (best[:, None, :] * np.exp(steps * (1.0, 0.0, 0.0)) + steps * (0.0, 1.0, 1.0)).reshape(-1, 3)
            near[:, 1] = np.clip(near[:, 1], 0.1, 1.0)
            near[:, 2] = np.clip(near[:, 2], -1.0, 1.0)
            grid = np.concatenate([grid, near])
            variances = np.r_[variances, _variances(u, near, scale, target, delays)]
            steps = 0.5 * steps
        grid = grid[np.argsort(variances)[: 8 * KEPT]]
        kept.append(grid[:KEPT])
    return np.concatenate(kept)


def _positions(u: FloatArray, grid: FloatArray) -> FloatArray:
    sizes, jumps, phases = grid.T
    jumps = sizes * jumps
    static = 0.5 * (sizes + jumps)
    return stick_slip(u, static, 0.5 * (sizes - jumps), u[0] + phases * static)


def _variances(u: FloatArray, grid: FloatArray, scale: int, y: FloatArray, delays: npt.NDArray[np.int_]) -> FloatArray:
    return np.array([fit.variance for fit in fit_models(thin(_positions(u, grid), scale), y, delays)])


def _delays(u: FloatArray, y: FloatArray, period: float) -> npt.NDArray[np.int_]:
    """Return delays to try [samples]: up to the linear loop's, which takes the lag of a sticking valve for delay."""
    longest = int(np.clip(period / 3.0, 2.0, min(60.0, y.size / 10.0)))
    (linear,) = fit_models(u[None], y, np.unique(np.linspace(0, longest, MAX_DELAYS).astype(int)))
    return np.unique([0, 1, linear.delay // 3, 2 * linear.delay // 3, linear.delay])


def thin(x: FloatArray, factor: int) -> FloatArray:
    """Return means of `factor` neighbours each, along the last axis."""
    if factor == 1:
        return x
    return np.asarray(x[..., : x.shape[-1] // factor * factor].reshape(*x.shape[:-1], -1, factor).mean(axis=-1))


def _compare(
    lanes: FloatArray,
    plain: FloatArray,
    y: FloatArray,
    period: float,
    grid: FloatArray,
    edges: FloatArray,
) -> ModelComparison:
    """Return the best of each kind; plain: u, and u clipped at each edge."""
    delays = _delays(plain[0], y, period)
    wave = 2.0 * np.pi * np.arange(y.size) / period
    fits = fit_models(lanes, y, delays)
    linear, *clips = fit_models(plain, y, delays)
    (outside,) = fit_models(plain[:1], y, delays, np.stack([np.cos(wave), np.sin(wave)]))
    (alone,) = fit_models(np.zeros((1, y.size)), y, delays[-1:])
    slips = [fit._replace(size=s, jump=s * j) for fit, (s, j, _) in zip(fits, grid.tolist(), strict=True)]
    return ModelComparison(
        alone,
        linear,
        min((fit for fit in slips if fit.jump > 0.0), key=_variance),
        min((fit for fit in slips if fit.jump == 0.0), key=_variance),
        min((fit._replace(size=float(edge)) for fit, edge in zip(clips, edges, strict=True)), key=_variance),
        outside,
        y.size,
    )


def _variance(fit: ModelFit) -> float:
    return fit.variance


def fit_models(
    x: FloatArray, y: FloatArray, delays: npt.NDArray[np.int_], waves: FloatArray | None = None
) -> list[ModelFit]:
    """Fit y to each row of x, shape (lanes, N), with the delay that leaves the least variance; waves: (K, N)."""
    first = ORDER + INPUTS + int(delays.max())
    target = y[first:]
    fixed = [*(y[first - i : y.size - i] for i in range(1, ORDER + 1)), np.ones(target.size)]
    common = np.stack([*fixed, *(waves[:, first:] if waves is not None else ())])  # (C, M)
    lanes, c = len(x), len(common)
    floor = 1e-9 * float(target @ target) / target.size + 1e-300  # of what such sums resolve
    variance, chosen = np.full(lanes, np.inf), np.zeros((lanes, c + INPUTS))
    late = np.zeros(lanes, np.int_)
    for delay in delays.tolist():
        moved = np.stack([x[:, first - i - delay : y.size - i - delay] for i in range(1, INPUTS + 1)], axis=1)
        gram = np.empty((lanes, c + INPUTS, c + INPUTS))
        gram[:, :c, :c] = common @ common.T
        gram[:, c:, :c] = moved @ common.T
        gram[:, :c, c:] = gram[:, c:, :c].transpose(0, 2, 1)
        gram[:, c:, c:] = moved @ moved.transpose(0, 2, 1)
        right = np.concatenate([np.broadcast_to(common @ target, (lanes, c)), moved @ target], axis=1)
        diagonal = np.arange(c + INPUTS)
        gram[:, diagonal, diagonal] = gram[:, diagonal, diagonal] * (1.0 + 1e-9) + 1e-300
        weights = np.linalg.solve(gram, right[:, :, None])[:, :, 0]
        left = (target @ target - np.einsum("li,li->l", weights, right)) / target.size
        better = left < variance
        variance, late = np.where(better, left, variance), np.where(better, delay, late)
        chosen = np.where(better[:, None], weights, chosen)
    order = [*range(ORDER), *range(c, c + INPUTS), *range(ORDER, c)]
    return [ModelFit(max(float(v), floor), w, int(d)) for v, w, d in zip(variance, chosen[:, order], late, strict=True)]


class Margins(NamedTuple):
    """What the log says of the loop's stability."""

    gain: float  # gain margin, at most 100
    peak: float  # of the sensitivity, at most 100
    explained: float  # share of the controller's steps that a PID law explains


def estimate_margins(fit: ModelFit, e: FloatArray, u: FloatArray) -> Margins:
    """Return gain margin and peak of the sensitivity of the loop of G, as fitted, and a PID law fitted to e and u.

    The law is u(k) - u(k-1) = c_0 e(k) + c_1 e(k-1) + c_2 e(k-2).
    """
    steps = np.diff(u)[1:]
    rows = np.stack([e[2:], e[1:-1], e[:-2]], axis=1)
    law = np.linalg.lstsq(rows, steps, rcond=None)[0]
    explained = 1.0 - float(np.var(steps - rows @ law) / max(float(np.var(steps)), 1e-300))
    w = np.geomspace(0.003, np.pi, 400)
    back = np.exp(-1j * w)
    a, b = fit.coefficients[:ORDER], fit.coefficients[ORDER : ORDER + INPUTS]
    plant = back ** (1 + fit.delay) * polynomial.polyval(back, b) / (1.0 - back * polynomial.polyval(back, a))
    loop = plant * polynomial.polyval(back, law) / (1.0 - back)
    crossings = np.flatnonzero((loop.imag[:-1] * loop.imag[1:] < 0.0) & (loop.real[:-1] < 0.0))
    strongest = max(float(np.max(-loop.real[crossings], initial=0.01)), -float(loop.real[-1]))  # L(pi) is real
    peak = float(np.max(1.0 / np.maximum(np.abs(1.0 + loop), 0.01)))
    return Margins(min(1.0 / strongest, 100.0), peak, explained)
