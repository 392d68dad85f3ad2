"""A simple detector of changes: least squares over blocks, optimal partitioning, the best subset of coefficients."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, pairwise
from typing import NamedTuple

import numpy as np
from scipy.signal import butter, sosfiltfilt

import servoscope as ss
from servoscope.core.arrays import FloatArray

BLOCK_S = 0.5
FASTER = 4.0  # times the cutoff, for the speed whose sign is that of friction
TANH_SHARE = 0.01  # of the largest speed, within which friction changes its sign
MARGIN = 1.5  # of the largest gain that a healthy recording has by one cut
MIN_BLOCKS = 6  # of a stretch
NAMES = "inertia", "viscous_friction", "coulomb_friction"  # and a constant


class Stretch(NamedTuple):
    """A stretch, and the ratio of each coefficient that changed: low, likely, high."""

    begin_s: float
    end_s: float
    ratios: dict[str, tuple[float, float, float]]


class BlockPartition:
    """Cuts a recording where separate fits leave less of u, and names the coefficients by the Bayesian information."""

    def __init__(self, cutoff_hz: float) -> None:
        self.cutoff_hz = cutoff_hz

    def _blocks(self, recording: ss.Recording) -> tuple[FloatArray, FloatArray]:
        """Return sums of products of [columns, u] by block, (K, 5, 5), and the time at which each begins."""
        rate, t = recording.sample_rate, recording.t

        def low(x: FloatArray, cutoff: float) -> FloatArray:
            return np.asarray(sosfiltfilt(butter(2, 2.0 * min(cutoff / rate, 0.4), output="sos"), x))

        y = low(recording.y, self.cutoff_hz)
        v = np.gradient(y) * rate
        fast = np.gradient(low(recording.y, FASTER * self.cutoff_hz)) * rate
        sign = low(np.tanh(fast / (TANH_SHARE * np.abs(fast).max())), self.cutoff_hz)
        u = low(recording.u, self.cutoff_hz)
        columns = np.column_stack([np.gradient(v) * rate, v, sign, np.ones_like(v), u])
        size = round(BLOCK_S * rate)
        edge = round(1.5 * rate / self.cutoff_hz)
        K = (len(t) - 2 * edge) // size
        cut = columns[edge : edge + K * size].reshape(K, size, -1)
        return np.swapaxes(cut, 1, 2) @ cut, t[edge : edge + K * size : size]

    def learn(self, healthy: Sequence[ss.Recording]) -> None:
        """Fit the healthy coefficients, the noise of a block's score, and what a cut has to gain."""
        blocks = [self._blocks(recording)[0] for recording in healthy]
        total = np.concatenate(blocks)
        A, c = total[:, :-1, :-1], total[:, :-1, -1]
        self.theta = np.linalg.solve(A.sum(axis=0), c.sum(axis=0))
        scores = c - A @ self.theta
        self.variance = float(np.einsum("ki,ij,kj->", scores, np.linalg.inv(A.sum(axis=0)), scores) / len(self.theta))
        self.cost = 0.0
        gains = [self._cut(part, 1.0, 2)[1] for part in blocks]
        self.cost = MARGIN * max(*gains, len(self.theta) * float(np.log(len(blocks[0]))))

    def _cut(self, blocks: FloatArray, cost: float, most: int = 10**9) -> tuple[list[int], float]:
        """Return the cuts of the best partition and its gain over none; with `most` = 2, the best single cut."""
        running = np.concatenate([np.zeros((1, *blocks.shape[1:])), np.cumsum(blocks, axis=0)])
        K = len(blocks)
        cost = 0.0 if most == 2 else cost

        def gain(i: object, j: object) -> FloatArray:
            S = running[j] - running[i]
            A, c = S[..., :-1, :-1] + 1e-9 * np.diag(np.diag(running[-1][:-1, :-1])), S[..., :-1, -1]
            w = c - S[..., :-1, :-1] @ self.theta
            return np.einsum("...i,...i->...", w, np.linalg.solve(A, w[..., None])[..., 0]) / self.variance / 2.0

        whole = float(gain(0, K))
        if most == 2:
            at = np.arange(MIN_BLOCKS, K - MIN_BLOCKS)
            split = gain(0, at) + gain(at, K)
            return [int(at[np.argmax(split)])], float(split.max()) - whole
        best, previous = np.full(K + 1, -np.inf), np.zeros(K + 1, dtype=int)
        best[0] = cost
        for j in range(MIN_BLOCKS, K + 1):
            i = np.arange(0, j - MIN_BLOCKS + 1)
            total = best[i] + gain(i, j) - cost
            previous[j], best[j] = i[np.argmax(total)], total.max()
        cuts, j = list[int](), K
        while previous[j] > 0:
            j = int(previous[j])
            cuts.append(j)
        return cuts[::-1], float(best[K]) - whole

    def judge(self, recording: ss.Recording) -> list[Stretch]:
        """Return the stretches of a recording."""
        blocks, t = self._blocks(recording)
        cuts = self._cut(blocks, self.cost)[0]
        edges = [0, *cuts, len(blocks)]
        stretches = []
        for i, j in pairwise(edges):
            begin, end = (float(recording.t[0]) if i == 0 else t[i]), (t[j] if j < len(t) else float(recording.t[-1]))
            stretches.append(Stretch(begin, end, self._subset(blocks[i:j].sum(axis=0), j - i)))
        return stretches

    def _subset(self, S: FloatArray, count: int) -> dict[str, tuple[float, float, float]]:
        """Return the ratios of the coefficients whose change explains a stretch best; the constant is always free."""
        A, w = S[:-1, :-1], S[:-1, -1] - S[:-1, :-1] @ self.theta
        best = (-np.inf, (), np.zeros(0), np.zeros(0))
        for free in (free for k in range(len(NAMES) + 1) for free in combinations(range(len(NAMES)), k)):
            at = [*free, len(NAMES)]
            C = np.linalg.inv(A[np.ix_(at, at)])
            moved = C @ w[at]
            worth = float(w[at] @ moved) / self.variance / 2.0 - len(free) * max(np.log(count), self.cost / len(w))
            if worth > best[0]:
                best = (worth, free, moved, np.sqrt(self.variance * np.diag(C)))
        _, free, moved, std = best
        return {
            NAMES[k]: tuple(1.0 + (moved[n] + z * std[n]) / self.theta[k] for z in (-1.96, 0.0, 1.96))
            for n, k in enumerate(free)
        }
