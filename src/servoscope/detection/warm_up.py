"""A warm-up that nobody measures: its course from the coefficients themselves, as losses and cooling shape it.

::

    T w' = s + k p(t) - w,   w(0) = w_0,   p = u y'/(its healthy mean)

with the time constant T of the machine, and w_0, s (surroundings) and k (what losses warm) of each recording: the
lumped thermal model of one body. Such a course is smooth; what breaks it is a change of the machine.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from servoscope.baseline.covariates import CovariateModel, CovariatePath, WarmUp
from servoscope.core.arrays import FloatArray, IntArray
from servoscope.detection.statistic import required_noncentrality
from servoscope.estimation.pipeline import Pipeline, RegressionRunner
from servoscope.signals import Recording

# channels of a course that a monitor has followed: the warm-up as a covariate, whose learned range is 0 to 1, its
# standard deviation, and the smallest jump that would be found
COURSE_CHANNELS = NAME, STD, JUMP = "warm_up", "warm_up_std", "warm_up_jump"
BLOCK_MEMORIES = 0.2  # memories over which the sums are taken
MAX_BLOCKS = 400
PRIOR_STD = 1.0  # of w_0, s and k around the middle of the learned range, where the recording does not tell
BREAK_BY_CHANCE = 1e-6  # probability with which a smooth course is called broken, over all moments
MAX_JUMPS = 3
MAX_ROUNDS = 8  # of Gauss and Newton
STEP = 1e-4  # of w, for derivatives
MIN_INFORMATION_SHARE = 1e-30  # of the best known information: less is rounding, as of a machine at rest


@dataclass(frozen=True, eq=False)
class BlockSums:
    """Sums of a regression over blocks of time: what a least-squares fit of anything slower needs."""

    normal: FloatArray  # sum phi phi', shape (m, n, n)
    moment: FloatArray  # sum phi eta, shape (m, n)
    first: IntArray  # first sample of each block, shape (m,)
    losses: FloatArray  # mean of u y' over each block, shape (m,)
    seconds: float  # length of a block

    @classmethod
    def of(cls, pipeline: Pipeline, recording: Recording) -> BlockSums:
        """Add up the usable samples of a recording."""
        N, n = recording.samples, pipeline.bank.n
        size = max(round(BLOCK_MEMORIES * pipeline.memory_samples), -(-N // MAX_BLOCKS), 1)
        runner, rows = RegressionRunner(pipeline), []
        for begin in range(0, N, size):
            at = slice(begin, min(begin + size, N))
            part = recording.rows(at)
            g = runner.advance(part.r, part.u, part.y, part.restart)
            phi, speed = g.phi[g.ok], np.diff(part.y)[~part.restart[1:]] * recording.sample_rate
            loss = float((part.u[1:][~part.restart[1:]] * speed).mean()) if speed.size else 0.0
            rows.append((phi.T @ phi, phi.T @ g.eta[g.ok], begin, loss))
        A, b, first, losses = (np.array(column) for column in zip(*rows, strict=True))
        return cls(A.reshape(-1, n, n), b.reshape(-1, n), first, losses, size / recording.sample_rate)

    def basis(self, time_constant_s: float, power: float) -> FloatArray:
        """Return what w_0, s and k contribute to w in the middle of each block, shape (m, 3)."""
        m = len(self.first)
        decay = np.exp(-(np.arange(m) + 0.5) * self.seconds / time_constant_s)
        keep, warmed = np.exp(-self.seconds / time_constant_s), np.zeros(m)
        if power:
            p, before = self.losses / power, 0.0
            for i in range(m):
                warmed[i] = 0.5 * (before + keep * before + (1.0 - keep) * p[i])
                before = keep * before + (1.0 - keep) * p[i]
        return np.stack([decay, 1.0 - decay, warmed], axis=1)

    def at_samples(self, values: FloatArray, samples: int) -> FloatArray:
        """Return values of the middles of the blocks (m,) at every sample, shape (N,)."""
        middles = 0.5 * (self.first + np.append(self.first[1:], samples))
        return np.asarray(np.interp(np.arange(samples), middles, values))


@dataclass(frozen=True, eq=False)
class WarmUpFit:
    """The course of a recording's warm-up, and the jumps that break it."""

    basis: FloatArray  # what w_0, s, k and jumps contribute to w, shape (m, 3 + jumps)
    x: FloatArray  # w_0, s, k and the jumps
    covariance: FloatArray  # of x
    jumps: tuple[int, ...]  # blocks with which they begin
    residual: FloatArray  # sums of phi times what is left of eta, shape (m, n)
    jacobian: FloatArray  # of the blocks' coefficients by all that was fitted, shape (m, n, q)
    cost: float  # sum of squares less that of eta

    @property
    def course(self) -> FloatArray:
        """The warmth w without the jumps, which no warming explains, in the middle of each block, shape (m,)."""
        return np.asarray(self.basis[:, :3] @ self.x[:3])

    @property
    def std(self) -> FloatArray:
        """Standard deviation of `course`, shape (m,)."""
        G, C = self.basis[:, :3], self.covariance[:3, :3]
        return np.asarray(np.sqrt(np.einsum("mi,ij,mj->m", G, C, G)))


def fit_course(
    sums: BlockSums, warm_up: WarmUp, theta: FloatArray, model: CovariateModel, jumps: tuple[int, ...] = ()
) -> WarmUpFit:
    """Fit w_0, s and k together with jumps of w at some blocks (Gauss and Newton).

    What a machine is off by from the first block on, and no warmth looks like, is free as well.
    """
    m, n = sums.moment.shape
    after = np.arange(m)[:, None] >= np.array(jumps, dtype=np.int64)
    G = np.hstack([sums.basis(warm_up.time_constant_s, warm_up.power), after])
    A, k = sums.normal, G.shape[1]
    middle, prior = np.zeros(k + n - 1), np.zeros(k + n - 1)
    middle[:2], prior[:3] = 0.5, warm_up.variance / PRIOR_STD**2
    p, J = middle.copy(), np.zeros((m, n, k + n - 1))
    for last in (*(False,) * MAX_ROUNDS, True):
        w = (G @ p[:k])[:, None]
        slope = (model.theta(theta, w + STEP) - model.theta(theta, w - STEP)) / (2.0 * STEP)
        alike = np.einsum("mij,mj->i", A, slope)
        J[:, :, :k] = slope[:, :, None] * G[:, None, :]
        J[:, :, k:] = np.linalg.svd(alike[None])[2][1:].T  # what is not alike
        fitted = model.theta(theta, w) + J[:, :, k:] @ p[k:]
        left = sums.moment - np.einsum("mij,mj->mi", A, fitted)
        H = np.einsum("mia,mij,mjb->ab", J, A, J) + np.diag(prior)
        H += np.diag(np.diag(H) <= MIN_INFORMATION_SHARE * H.max())  # what the recording does not show stays as it is
        size = np.sqrt(np.diag(H))
        C = np.linalg.inv(H / np.outer(size, size)) / np.outer(size, size)
        if not last:
            p = p + C @ (np.einsum("mia,mi->a", J, left) - prior * (p - middle))
    cost = -float(np.einsum("mi,mi->", fitted, sums.moment + left))
    return WarmUpFit(G, p[:k], warm_up.variance * C[:k, :k], jumps, left, J, cost)


def _most_likely_jump(sums: BlockSums, fit: WarmUpFit, variance: float) -> tuple[int, float, float]:
    """Return the block from which on a jump of w explains most, its score statistic, and what a jump of 1 adds to it.

    The statistic (Rao, 1948) is chi-square of 1. A jump needs two blocks before and after it; the last value is that
    of the moment that shows one best.
    """
    A, J = sums.normal, fit.jacobian
    slope = J[:, :, 0] + J[:, :, 1]  # what w_0 and s contribute adds up to 1 at all times
    known = np.linalg.pinv(np.einsum("mia,mij,mjb->ab", J, A, J), hermitian=True)

    def since(values: FloatArray) -> FloatArray:
        return np.cumsum(values[::-1], axis=0)[::-1]

    score, own = since((fit.residual * slope).sum(axis=1)), since(np.einsum("mi,mij,mj->m", slope, A, slope))
    cross = since(np.einsum("mi,mij,mjb->mb", slope, A, J))
    information = own - np.einsum("ma,ab,mb->m", cross, known, cross)
    at = np.arange(2, len(A) - 2)
    at = at[information[at] > 1e-9 * own[0]]
    if not at.size:
        return 0, 0.0, 0.0
    statistic = score[at] ** 2 / (information[at] * variance)
    best = int(np.argmax(statistic))
    return int(at[best]), float(statistic[best]), float(information[at].max()) / variance


def find_course(sums: BlockSums, warm_up: WarmUp, theta: FloatArray, model: CovariateModel) -> tuple[WarmUpFit, float]:
    """Fit the course, with a jump wherever a smooth one is too unlikely (forward selection).

    Returns also the smallest jump of w that would be found with 90 % probability; infinite where none would.
    """
    from scipy import special

    fit = fit_course(sums, warm_up, theta, model)
    limit = float(special.chdtri(1.0, BREAK_BY_CHANCE / len(sums.first)))
    at, statistic, information = _most_likely_jump(sums, fit, warm_up.variance)
    smallest = float(np.sqrt(required_noncentrality(1, limit) / information)) if information else np.inf
    while statistic > limit and at not in fit.jumps and len(fit.jumps) < MAX_JUMPS:
        fit = fit_course(sums, warm_up, theta, model, (*fit.jumps, at))
        at, statistic, _ = _most_likely_jump(sums, fit, warm_up.variance)
    return fit, smallest


def follow_warm_up(
    pipeline: Pipeline, model: CovariateModel, theta: FloatArray, recording: Recording, memory: float
) -> CovariatePath:
    """Return how the healthy coefficients of a recording move with the warm-up that they tell themselves."""
    assert model.warm_up is not None, "the covariates are measured"
    if STD in recording.channels:
        path, jump = CovariatePath.of(model, theta, recording.channels, memory), recording.channels[JUMP][-1]
        return replace(path, std=recording.channels[STD], jump=float(jump))
    sums = BlockSums.of(pipeline, recording)
    fit, smallest = find_course(sums, model.warm_up, theta, model)
    course, std = (sums.at_samples(values, recording.samples) for values in (fit.course, fit.std))
    return replace(CovariatePath.of(model, theta, {**recording.channels, NAME: course}, memory), std=std, jump=smallest)
