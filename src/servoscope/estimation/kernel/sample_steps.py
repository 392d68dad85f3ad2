"""One sample of one asset through the whole chain: filters, estimator, covariance, sequential test.

Traced arithmetic (see `core.jit`) that becomes straight-line code for the sizes of one loop; a lane is an asset. With
one lane it is the recursion of one series, kept in registers; with many, the same lines become vectors.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType, SimpleNamespace
from typing import Any

from servoscope.core.jit import Bool, Float, dot, fma, maximum, minimum, sum_products, where
from servoscope.estimation.kernel import sparse_lti
from servoscope.estimation.kernel.cusum import (
    CLIP,
    accumulate_sums,
    update_cusum,
    update_cusum_by_sums,
    whiten_sample,
)
from servoscope.estimation.kernel.spec import KernelSpec
from servoscope.estimation.moments import propagate_covariance, propagate_initial_share
from servoscope.estimation.update import read_matrix, write_matrix
from servoscope.models.plants.columns import COLUMN_FORMS

# counters at the head of a state row
ARMED, WAIT, SAMPLE, UPDATES, SKIPPED, STILL, WHITENED, CROSSED = range(8)
HEADER_SIZE = 8
CUSUM_BATCH = 8  # the number of CUSUMs is rounded up to this, so that few kernels serve many baselines
# status of a sample: missing, held back, may update the estimator, between two updates
MISSING, HELD, USED, BETWEEN = -1.0, 0.0, 1.0, 2.0
# Of the speed of a reference, as shares of the parts that cancel in it: what rounding leaves, and where it counts as
# standing still. The differentiator's tail falls to no less than a fifth from sample to sample: it cannot jump the gap.
ROUNDING_SHARE, STANDSTILL_SHARE = 1e-14, 1e-12
MIN_SPEED = 1e-30  # below, a reference that rests at 0 stands still
MAX_PHYSICAL = 1e100  # larger is no physical signal; its square would overflow and stay in the state for ever
TILE = 16  # largest number of samples that are fetched together


class SampleSteps:
    """The steps of one sample for the sizes of a specification.

    c are constants, s is the state, h its counters, v the regressors [eta, phi, z], `shadow` those of the healthy loop,
    e the whitened residual. The sequential test takes w and the sample numbers `when` of a tile; g are its CUSUMs. With
    `single_lane`, neighbouring CUSUMs of one asset are the lanes of `update_cusums`.
    """

    def __init__(self, spec: KernelSpec, estimator: ModuleType, single_lane: bool = False) -> None:
        self.size, self.to, self.at = spec.sizes, SimpleNamespace(**dict(spec.to)), SimpleNamespace(**dict(spec.at))
        self._bank, self._shadow, self._estimator, self.single_lane = spec.bank, spec.shadow, estimator, single_lane
        self.sums, self.columns = spec.sums, spec.columns

    def begin_evaluation(self, s: Any, h: Any) -> None:
        """Forget the largest CUSUM of the evaluation before."""
        if self.size.shadow:
            level = s[self.to.level]
            h[CROSSED] = where(level < 1.0, 0.0, h[CROSSED])
            s[self.to.peak] = level

    def clear_size(self, e: Any) -> None:
        """Begin the sums of `accumulate_size`."""
        e[0] = e[1] = 0.0

    def accumulate_size(self, e: Any, tile: Any, i: Any) -> None:
        """Sum up the magnitudes of samples, and count restarts."""
        r, u, y = tile[i], tile[i + TILE], tile[i + 2 * TILE]
        e[0] = e[0] + ((abs(r) + abs(u)) + abs(y))
        e[1] = e[1] + tile[i + 3 * TILE]

    def is_undisturbed(self, h: Any, e: Any) -> Bool:
        """Return whether all samples that were summed up update the estimator: none is missing, restarts or waits."""
        undisturbed: Bool = (
            (e[0] < MAX_PHYSICAL) & (e[1] <= 0.0) & (h[ARMED] > 0.0) & (h[WAIT] <= 0.0)
        )  # NaN is below nothing
        return undisturbed

    def advance_shadow(self, c: Any, s: Any, w: Any, tile: Any, i: Any) -> None:
        """Pass an undisturbed r through the healthy loop: columns and residual of the test go to w."""
        outputs = sparse_lti.advance_system(self._shadow, c, self.at.shadow, s, self.to.shadow, [tile[i]])
        for k, number in zip([self.columns, *range(self.columns)], outputs, strict=False):
            w[i * (self.columns + 1) + k] = number

    def update_undisturbed(self, c: Any, s: Any, h: Any, w: Any, when: Any, tile: Any, i: Any) -> None:
        """Process an undisturbed sample: `advance_filters` and `update_estimate` without their special cases."""
        h[SAMPLE] = h[SAMPLE] + 1.0
        x = self._inputs(c, tile[i], tile[i + TILE], tile[i + 2 * TILE], None)
        v = sparse_lti.advance_system(self._bank, c, self.at.bank, s, self.to.x, x)
        phi = self._update_theta(c, s, h, v)
        if self.size.shadow:
            row = i * (self.columns + 1) + self.columns
            w[row] = self._residual(c, v, w[row], phi)
            if not self.sums:
                when[i] = h[SAMPLE]

    def whiten_undisturbed(self, c: Any, s: Any, h: Any, w: Any, i: Any) -> None:
        """Whiten what `advance_shadow` and `update_undisturbed` left in w."""
        row = i * (self.columns + 1)
        if self.sums:
            self._accumulate(c, s, h, [w[row + k] for k in range(self.columns)], w[row + self.columns])
        else:
            e = self._whiten(c, s, h, w[row + self.columns], [w[row + k] for k in range(self.size.n)])
            self._store_whitened(s, e, h[WHITENED] > c[self.at.warm], w, i)

    def classify_sample(self, h: Any, status: Any, tile: Any, i: Any) -> tuple[Bool, Bool]:
        """Count a sample; return whether it is complete, and whether the filters begin with it.

        Numbers of one that is missing become zeros: nothing may depend on them.
        """
        h[SAMPLE] = h[SAMPLE] + 1.0
        status[0] = MISSING
        r, u, y = (tile[i + k * TILE] for k in range(3))
        complete: Bool = (abs(r) < MAX_PHYSICAL) & (abs(u) < MAX_PHYSICAL) & (abs(y) < MAX_PHYSICAL)
        if not self.single_lane:
            for k, number in enumerate((r, u, y)):
                tile[i + k * TILE] = where(complete, number, 0.0)
        begins: Bool = complete & ((tile[i + 3 * TILE] > 0.0) | (h[ARMED] <= 0.0))
        h[ARMED] = where(complete, h[ARMED], 0.0)
        return complete, begins

    def classify_update(self, status: Any) -> tuple[Bool, Bool]:
        """Return whether a sample updates the estimator, and whether its noise is forgotten."""
        return self.is_update(status), status[0] < USED

    def begin_filters(self, c: Any, s: Any, h: Any, tile: Any, i: Any) -> None:
        """Put the filters into their steady state at one sample, after a gap."""
        r, u, y = tile[i], tile[i + TILE], tile[i + 2 * TILE]
        h[ARMED] = 1.0
        h[WAIT] = c[self.at.wait]
        speed = None
        if self.size.speed:
            source = r if self.size.speed == 2 else y
            for j in range(2):
                s[self.to.velocity + j] = c[self.at.velocity + 9 + j] * source
            speed, parts = self._speed(c, s, source)
            if self.size.speed == 2:
                speed = where(abs(speed) <= ROUNDING_SHARE * parts, 0.0, speed)
        w = self._inputs(c, r, u, y, speed)
        for k in range(self.size.states):
            s[self.to.x + k] = dot([c[self.at.steady + k * len(w) + j] for j in range(len(w))], w)
        for k in range(self.size.shadow):
            s[self.to.shadow + k] = c[self.at.shadow_steady + k] * r

    def advance_filters(
        self, c: Any, s: Any, h: Any, status: Any, v: Any, shadow: Any, tile: Any, i: Any, due: Any
    ) -> None:
        """Pass one complete sample through the filters.

        Its status is `USED`, but `HELD` while the filters settle, the axis rests or u is in the dead zone, and
        `BETWEEN` where no update is due.
        """
        r, u, y = tile[i], tile[i + TILE], tile[i + 2 * TILE]
        speed: Any = None
        hold: Any = None
        if self.size.speed:
            source = r if self.size.speed == 2 else y
            speed, parts = self._speed(c, s, source)
            k, x = self.at.velocity, [s[self.to.velocity], s[self.to.velocity + 1]]
            ahead = [c[k + 2 * j] * x[0] + c[k + 2 * j + 1] * x[1] + c[k + 4 + j] * source for j in range(2)]
            if self.size.speed == 2:
                # a reference stands still exactly: the filter is stopped before the sign of its tail, that of the last
                # motion, is lost in rounding, which differs from machine to machine; without a motion it is 0
                stands = abs(speed) <= STANDSTILL_SHARE * parts + MIN_SPEED
                ahead = [where(stands, old, new) for old, new in zip(x, ahead, strict=True)]
                speed = where(abs(speed) <= ROUNDING_SHARE * parts, 0.0, speed)
            for j in range(2):
                s[self.to.velocity + j] = ahead[j]
        w = self._inputs(c, r, u, y, speed)
        if self.size.speed:
            # a reversal is short; an axis that has stood longer than the filters remember is at rest
            drift = fma(speed - s[self.to.drift], c[self.at.forget], s[self.to.drift])  # the speed without its noise
            s[self.to.drift] = drift
            h[STILL] = where(abs(drift) < c[self.at.still_speed], h[STILL] + 1.0, 0.0)
            hold = h[STILL] > c[self.at.wait]
            if self.size.gated:
                dead = (w[1] >= c[self.at.dead_low]) & (w[1] <= c[self.at.dead_high])
                hold = hold | (abs(speed) <= c[self.at.rest_speed]) | dead
        for k, number in enumerate(sparse_lti.advance_system(self._bank, c, self.at.bank, s, self.to.x, w)):
            v[k] = number
        for k, number in enumerate(sparse_lti.advance_system(self._shadow, c, self.at.shadow, s, self.to.shadow, w)):
            shadow[k] = number
        waiting = h[WAIT]
        settling = waiting > 0.0
        # what enters the filters while it rests has nothing to do with the motion: wait until they have forgotten it
        h[WAIT] = (
            maximum(waiting - 1.0, 0.0) if hold is None else where(hold, c[self.at.wait], maximum(waiting - 1.0, 0.0))
        )
        held = settling if hold is None else hold | settling
        status[0] = where(held, HELD, where(due, USED, BETWEEN))

    def is_update(self, status: Any) -> Bool:
        """Return whether the sample updates the estimator."""
        used: Bool = (status[0] >= USED) & (status[0] <= USED)
        return used

    def update_estimate(self, c: Any, s: Any, h: Any, v: Any, shadow: Any, e: Any, extra: Any) -> None:
        """Update theta and P, then all that follows from the update; `extra` is the estimator's private state."""
        phi = self._update_theta(c, s, h, v) if self.size.steady else self._update_all(c, s, h, v, extra)
        if self.size.shadow:
            self._test_update(c, s, h, v, shadow, e, phi)

    def _update_all(self, c: Any, s: Any, h: Any, v: Any, extra: Any) -> list[Any]:
        """Update theta and P by any estimator, in double precision; return phi."""
        n, to, at = self.size.n, self.to, self.at
        theta, phi = [s[to.theta + i] for i in range(n)], [v[1 + i] for i in range(n)]
        residual = sum_products([-x for x in phi], theta, v[0])
        z = [v[self.size.rows - n + i] for i in range(n)]
        vectors = ([x.widen() for x in vector] for vector in (theta, phi, z))
        matrices = read_matrix(s, n, to.P), read_matrix(c, n, at.P_d)
        P, P_d = ([[x.widen() for x in row] for row in matrix] for matrix in matrices)
        numbers = c[at.R].widen(), c[at.memory].widen(), v[0].widen()
        wide_theta, *signals = vectors
        new = self._estimator.update(wide_theta, P, P_d, *numbers, *signals, extra)
        for i in range(n):
            s[to.theta + i] = new.theta[i]
        write_matrix(s, new.P, to.P)
        h[UPDATES] = h[UPDATES] + (1.0 - new.refused)
        h[SKIPPED] = h[SKIPPED] + new.refused
        power = self._mean_square(c, s, residual)
        s[to.power] = where(new.refused > 0.0, s[to.power], power)
        self._propagate(c, s, phi, [Float(v.printer, "", v.kind).cast(K) for K in new.K])
        return phi

    def reset_noise(self, s: Any, h: Any) -> None:
        """Forget the noise before a gap or a rest."""
        size, to = self.size, self.to
        spans = [(to.M, size.lags * size.n)]
        if size.shadow:
            h[WHITENED] = 0.0
            spans.append((to.white, (1 if self.sums else size.n + 1) * size.memory))
            if not self.sums:
                spans.append((to.psi, self.columns))
        for begin, count in spans:
            for i in range(count):
                s[begin + i] = 0.0

    def store_residual(self, c: Any, s: Any, h: Any, status: Any, e: Any, w: Any, when: Any, i: Any) -> None:
        """Store a sample for the sequential test; it counts once the whitening filter has forgotten its start."""
        used = self.is_update(status)
        self._store_whitened(s, e[0], used & (h[WHITENED] > c[self.at.warm]), w, i)
        when[i] = where(used, h[SAMPLE], 0.0)

    def update_cusums(self, c: Any, g: Any, w: Any, top: Any, i: Any) -> None:
        """Update the CUSUMs g with the whitened residual of sample i; c begins with their weights."""
        columns, batch = self.columns, self.size.watched // CUSUM_BATCH if self.single_lane else CUSUM_BATCH
        count = batch if self.single_lane else self.size.watched
        psi, white, best = [w[i * (columns + 1) + k] for k in range(columns)], w[i * (columns + 1) + columns], top[i]
        for j in range(batch):
            g[j] = update_cusum([c[j + count * k] for k in range(columns)], psi, white, g[j], c[j + count * columns])
            best = maximum(best, g[j])
        top[i] = best

    def update_cusums_by_sums(self, c: Any, g: Any, sums: Any, top: Any, i: Any) -> None:
        """Update the CUSUMs g with the sums of an evaluation; c begins with their weights, `top` is row i."""
        batch = self.size.watched // CUSUM_BATCH if self.single_lane else CUSUM_BATCH
        count, best = batch if self.single_lane else self.size.watched, top[i]
        for j in range(batch):
            weights = [c[j + count * k] for k in range(self.sums)]
            g[j] = update_cusum_by_sums(weights, [sums[k] for k in range(self.sums)], g[j])
            best = maximum(best, g[j])
        top[i] = best

    def end_evaluation(self, s: Any, h: Any, top: Any) -> None:
        """Store the level of the largest CUSUM as `update_alarm` does, and begin the sums anew."""
        self.update_alarm(s, h, top, [h[SAMPLE]], 0)
        for k in range(self.sums):
            s[self.to.sums + k] = 0.0

    def reduce_cusums(self, top: Any, level: Any, i: Any) -> None:
        """Write the largest of neighbouring CUSUMs of one asset as its level."""
        levels = [top[i * CUSUM_BATCH + j] for j in range(CUSUM_BATCH)]
        while len(levels) > 1:
            levels = [maximum(a, b) for a, b in zip(levels[::2], levels[1::2], strict=True)]
        level[i] = levels[0]

    def update_alarm(self, s: Any, h: Any, top: Any, when: Any, i: Any) -> None:
        """Store the level of the largest CUSUM, and the first sample at which one passes its limit."""
        level, number = top[i], when[i]
        used = number > 0.0
        s[self.to.peak] = where(used, maximum(s[self.to.peak], level), s[self.to.peak])
        s[self.to.level] = where(used, level, s[self.to.level])
        h[CROSSED] = where(used & (level >= 1.0) & (h[CROSSED] <= 0.0), number, h[CROSSED])

    def _speed(self, c: Any, s: Any, source: Any) -> tuple[Any, Any]:
        """Return the speed, and the sum of the magnitudes that cancel in it."""
        k = self.at.velocity  # A (2, 2), B, C, D, steady state
        # not fused: at rest what is left of it is rounding, whose sign must not hang on how the sum is rounded
        parts = c[k + 8] * source, c[k + 6] * s[self.to.velocity], c[k + 7] * s[self.to.velocity + 1]
        speed = parts[0] + parts[1] + parts[2]
        return speed, abs(parts[0]) + abs(parts[1]) + abs(parts[2])

    def _inputs(self, c: Any, r: Any, u: Any, y: Any, speed: Any) -> list[Any]:
        """Return the bank's inputs: r, u within its limits, y, and the columns of friction and offset."""
        w, k = [r, minimum(maximum(u, c[self.at.low]), c[self.at.high]), y], self.at.shapes
        for column in self.size.nonlinear:
            form = COLUMN_FORMS[column]
            shape = (c[k], c[k + 1]) if form.shaped else ()
            w.append(form.trace(y, speed, lambda: c[self.at.sign_speed], *shape))
            k += len(shape)
        return w

    def _mean_square(self, c: Any, s: Any, residual: Any) -> Any:
        return fma(fma(residual, residual, -s[self.to.power]), c[self.at.share], s[self.to.power])

    def _update_theta(self, c: Any, s: Any, h: Any, v: Any) -> list[Any]:
        """Update theta with an estimator whose P stays at P_d, and its covariance; return phi."""
        phi = [v[1 + i] for i in range(self.size.n)]
        theta = [s[self.to.theta + i] for i in range(self.size.n)]
        residual = v[0] - dot(phi, theta)
        K = self._estimator.steady_gain(c[self.at.R], phi)
        for i, gain in enumerate(K):
            s[self.to.theta + i] = fma(gain, residual, theta[i])
        h[UPDATES] = h[UPDATES] + 1.0
        s[self.to.power] = self._mean_square(c, s, residual)
        self._propagate(c, s, phi, K)
        return phi

    def _propagate(self, c: Any, s: Any, phi: Sequence[Any], K: Sequence[Any]) -> None:
        propagate_covariance(c, self.at.noise, s, self.to.S, self.size.lags, phi, K)
        if self.size.start:
            propagate_initial_share(s, self.to.Psi, phi, K)

    def _test_update(self, c: Any, s: Any, h: Any, v: Any, shadow: Any, e: Any, phi: Sequence[Any]) -> None:
        """Whiten what the sequential test takes of one update, or add it to the sums of the evaluation."""
        residual = self._residual(c, v, shadow[0], phi)
        if self.sums:
            self._accumulate(c, s, h, [shadow[1 + k] for k in range(self.columns)], residual)
        else:
            e[0] = self._whiten(c, s, h, residual, [shadow[1 + i] for i in range(self.size.n)])

    def _accumulate(self, c: Any, s: Any, h: Any, psi: Sequence[Any], residual: Any) -> None:
        """Whiten a residual; add it, times white columns, to the sums that move the CUSUMs once per evaluation."""
        e = self._whiten_residual(c, s, h, residual)
        counts = h[WHITENED] > c[self.at.warm]
        accumulate_sums(s, self.to.sums, [where(counts, column, 0.0) for column in psi], e)

    def _residual(self, c: Any, v: Any, expected: Any, phi: Sequence[Any]) -> Any:
        """Return the residual minus the shadow's."""
        return v[0] - expected - dot([c[self.at.apart + i] for i in range(self.size.n)], phi)

    def _whiten(self, c: Any, s: Any, h: Any, residual: Any, columns: Sequence[Any]) -> Any:
        """Whiten the columns to psi, behind which delayed copies of the last stand; return the white residual."""
        memory, to = self.size.memory, self.to
        for k in range(self.columns - 1, len(columns) - 1, -1):
            s[to.psi + k] = s[to.psi + k - 1]
        for i, column in enumerate(columns):
            s[to.psi + i] = whiten_sample(c, self.at.white, s, to.white + (1 + i) * memory, memory, column)
        return self._whiten_residual(c, s, h, residual)

    def _whiten_residual(self, c: Any, s: Any, h: Any, residual: Any) -> Any:
        h[WHITENED] = h[WHITENED] + 1.0
        white = whiten_sample(c, self.at.white, s, self.to.white, self.size.memory, residual)
        return minimum(maximum(white, -CLIP), CLIP)

    def _store_whitened(self, s: Any, e: Any, counts: Bool, w: Any, i: Any) -> None:
        """Write columns and residual of sample i to w; no CUSUM moves where all of them are zero."""
        for k in range(self.columns):
            w[i * (self.columns + 1) + k] = where(counts, s[self.to.psi + k], 0.0)
        w[i * (self.columns + 1) + self.columns] = where(counts, e, 0.0)
