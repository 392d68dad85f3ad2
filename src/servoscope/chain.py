"""One sample of one asset through the whole chain: filters, estimator, covariance, sequential test, evaluation.

Said in `servoscope.arithmetic`, so that it becomes straight-line code for the sizes of one loop; a lane is an asset.
With one lane it is the recursion of one series, kept in registers; with many, the same lines become vectors.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple

from servoscope import straight
from servoscope.arithmetic import Truth, dot, fma, larger, smaller, where
from servoscope.cusum import CLIP, LAGS, grown, whitened
from servoscope.propagation import remember, spread
from servoscope.straight import Pattern

# counters at the head of a state row
ARMED, WAIT, SAMPLE, UPDATES, SKIPPED, STILL, USED_UP, CROSSED = range(8)
HEAD = 8
WATCHED = 8  # CUSUMs are counted in such steps, so that few codes serve many baselines
# what is said of a sample
MISSING, HELD, USED, BETWEEN = -1.0, 0.0, 1.0, 2.0
ABSURD = 1e100  # no physical signal; its square would overflow and stay in the state for ever
TILE = 16  # samples that are fetched together, at most


class Sizes(NamedTuple):
    """What code is compiled for."""

    n: int
    rows: int
    inputs: int
    states: int
    speed: int
    gated: bool
    codes: tuple[int, ...]
    lags: int
    shadow: int
    memory: int
    watched: int
    steady: bool
    extra: int
    frequencies: int
    start: bool
    row: int
    floats: int


class Plan(NamedTuple):
    """Sizes, places and code of a recursion; equal plans share their machine code."""

    estimator: str
    sizes: Sizes
    to: tuple[tuple[str, int], ...]
    at: tuple[tuple[str, int], ...]
    bank: Pattern
    shadow: Pattern


class Chain:
    """The steps of one sample for the sizes of a plan.

    c are constants, s the state, h its counters, v the regressors [eta, phi, z], `shadow` those of the healthy loop, e
    the whitened residual, w and `when` what the sequential test takes of the samples of a tile, g its CUSUMs; the
    places of the plan say what stands where. With `alone`, neighbouring CUSUMs of one asset are lanes for `listen`.
    """

    def __init__(self, plan: Plan, steady: Any, alone: bool = False) -> None:
        self.size, self.to, self.at = plan.sizes, SimpleNamespace(**dict(plan.to)), SimpleNamespace(**dict(plan.at))
        self._bank, self._shadow, self._steady, self.alone = plan.bank, plan.shadow, steady, alone

    def renew(self, s: Any, h: Any) -> None:
        """Begin a new evaluation."""
        if self.size.shadow:
            level = s[self.to.level]
            h[CROSSED] = where(level < 1.0, 0.0, h[CROSSED])
            s[self.to.peak] = level

    def weigh(self, e: Any, tile: Any, i: Any) -> None:
        """Add up how large samples are, and how many restart."""
        r, u, y = tile[i], tile[i + TILE], tile[i + 2 * TILE]
        e[0] = e[0] + ((abs(r) + abs(u)) + abs(y))
        e[1] = e[1] + tile[i + 3 * TILE]

    def calm(self, h: Any, e: Any) -> Truth:
        """Return whether nothing is odd about samples that were weighed: all of them update the estimator."""
        calm: Truth = (e[0] < ABSURD) & (e[1] <= 0.0) & (h[ARMED] > 0.0) & (h[WAIT] <= 0.0)  # NaN is below nothing
        return calm

    def glide(self, c: Any, s: Any, h: Any, w: Any, when: Any, tile: Any, i: Any) -> None:
        """Take a sample of calm ones; what `advance` and `learn` do, without their exceptions."""
        h[SAMPLE] = h[SAMPLE] + 1.0
        x = self._inputs(c, tile[i], tile[i + TILE], tile[i + 2 * TILE], None)
        v = straight.advance(self._bank, c, self.at.bank, s, self.to.x, x)
        shadow = straight.advance(self._shadow, c, self.at.shadow, s, self.to.shadow, x)
        e: dict[int, Any] = {}
        self.learn(c, s, h, v, shadow, e)
        if self.size.shadow:
            self._hand_over(s, e, h[USED_UP] > c[self.at.warm], w, i)
            when[i] = h[SAMPLE]

    def tick(self, h: Any, tile: Any, i: Any) -> Truth:
        """Count a sample; return whether there is nothing odd about it."""
        h[SAMPLE] = h[SAMPLE] + 1.0
        r, u, y = tile[i], tile[i + TILE], tile[i + 2 * TILE]
        whole = (abs(r) < ABSURD) & (abs(u) < ABSURD) & (abs(y) < ABSURD)
        sound: Truth = whole & (tile[i + 3 * TILE] <= 0.0) & (h[ARMED] > 0.0)
        return sound

    def begin(self, c: Any, s: Any, h: Any, tile: Any, i: Any) -> None:
        """Put the filters into their steady state at one sample, after a gap."""
        r, u, y = tile[i], tile[i + TILE], tile[i + 2 * TILE]
        h[ARMED] = 1.0
        h[WAIT] = c[self.at.wait]
        speed = None
        if self.size.speed:
            source = r if self.size.speed == 2 else y
            for j in range(2):
                s[self.to.velocity + j] = c[self.at.velocity + 9 + j] * source
            speed = self._speed(c, s, source)
        w = self._inputs(c, r, u, y, speed)
        for k in range(self.size.states):
            s[self.to.x + k] = dot([c[self.at.steady + k * len(w) + j] for j in range(len(w))], w)
        for k in range(self.size.shadow):
            s[self.to.shadow + k] = c[self.at.shadow_steady + k] * r

    def advance(self, c: Any, s: Any, h: Any, said: Any, v: Any, shadow: Any, tile: Any, i: Any, turn: Any) -> Truth:
        """Pass one whole sample through the filters.

        It is said to be `USED` when it may update the estimator, `HELD` when the filters settle, the axis rests or u is
        dead, `BETWEEN` when it is not the turn of the estimator. Returns whether it is `USED`.
        """
        r, u, y = tile[i], tile[i + TILE], tile[i + 2 * TILE]
        speed: Any = None
        hold: Any = None
        if self.size.speed:
            source = r if self.size.speed == 2 else y
            speed = self._speed(c, s, source)
            k, x = self.at.velocity, [s[self.to.velocity], s[self.to.velocity + 1]]
            for j in range(2):
                s[self.to.velocity + j] = c[k + 2 * j] * x[0] + c[k + 2 * j + 1] * x[1] + c[k + 4 + j] * source
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
        for k, number in enumerate(straight.advance(self._bank, c, self.at.bank, s, self.to.x, w)):
            v[k] = number
        for k, number in enumerate(straight.advance(self._shadow, c, self.at.shadow, s, self.to.shadow, w)):
            shadow[k] = number
        waiting = h[WAIT]
        settling = waiting > 0.0
        # what enters the filters while it rests has nothing to do with the motion: wait until they have forgotten it
        h[WAIT] = (
            larger(waiting - 1.0, 0.0) if hold is None else where(hold, c[self.at.wait], larger(waiting - 1.0, 0.0))
        )
        held = settling if hold is None else hold | settling
        said[0] = where(held, HELD, where(turn, USED, BETWEEN))
        return self.used(said)

    def used(self, said: Any) -> Truth:
        """Return whether the sample updates the estimator."""
        used: Truth = (said[0] >= USED) & (said[0] <= USED)
        return used

    def learn(self, c: Any, s: Any, h: Any, v: Any, shadow: Any, e: Any) -> None:
        """Take one sample into the estimate, with an estimator whose P stays at P_d, and into all that goes with it."""
        phi = [v[1 + i] for i in range(self.size.n)]
        theta = [s[self.to.theta + i] for i in range(self.size.n)]
        left = v[0] - dot(phi, theta)
        K = self._steady(c[self.at.R], phi)
        for i, gain in enumerate(K):
            s[self.to.theta + i] = fma(gain, left, theta[i])
        h[UPDATES] = h[UPDATES] + 1.0
        s[self.to.power] = self._mean(c, s, left)
        self._carry(c, s, h, v, shadow, e, phi, K)

    def follow(self, c: Any, s: Any, h: Any, v: Any, shadow: Any, e: Any, k: Any) -> None:
        """Do as `learn` behind an estimator that has updated theta and P; k holds its gain, residual and status."""
        n = self.size.n
        refused = k[n + 1]
        h[UPDATES] = h[UPDATES] + (1.0 - refused)
        h[SKIPPED] = h[SKIPPED] + refused
        s[self.to.power] = where(refused > 0.0, s[self.to.power], self._mean(c, s, k[n]))
        self._carry(c, s, h, v, shadow, e, [v[1 + i] for i in range(n)], [k[i] for i in range(n)])

    def forget(self, s: Any, h: Any) -> None:
        """Begin with new noise after a gap or a rest."""
        size, to = self.size, self.to
        spans = [(to.M, size.lags * size.n)]
        if size.shadow:
            h[USED_UP] = 0.0
            spans += [(to.white, (size.n + 1) * size.memory), (to.psi, size.n + LAGS)]
        for begin, count in spans:
            for i in range(count):
                s[begin + i] = 0.0

    def note(self, c: Any, s: Any, h: Any, said: Any, e: Any, w: Any, when: Any, i: Any) -> None:
        """Hand a sample over to the sequential test; it counts once the whitening filter has forgotten its start."""
        used = self.used(said)
        self._hand_over(s, e, used & (h[USED_UP] > c[self.at.warm]), w, i)
        when[i] = where(used, h[SAMPLE], 0.0)

    def listen(self, c: Any, g: Any, w: Any, top: Any, i: Any) -> None:
        """Add the whitened residual of sample i to some CUSUMs, which stand in g; c begins with their weights."""
        columns, each = self.size.n + LAGS, self.size.watched // WATCHED if self.alone else WATCHED
        count = each if self.alone else self.size.watched
        psi, white, best = [w[i * (columns + 1) + k] for k in range(columns)], w[i * (columns + 1) + columns], top[i]
        for j in range(each):
            g[j] = grown([c[j + count * k] for k in range(columns)], psi, white, g[j], c[j + count * columns])
            best = larger(best, g[j])
        top[i] = best

    def highest(self, top: Any, i: Any) -> None:
        """Gather the largest of neighbouring CUSUMs of one asset in the first of them."""
        found = [top[i * WATCHED + j] for j in range(WATCHED)]
        while len(found) > 1:
            found = [larger(a, b) for a, b in zip(found[::2], found[1::2], strict=True)]
        top[i * WATCHED] = found[0]

    def alarm(self, s: Any, h: Any, top: Any, when: Any, i: Any) -> None:
        """Note how high the largest CUSUM is, and when one passes its limit."""
        level, number = top[i], when[i]
        used = number > 0.0
        s[self.to.peak] = where(used, larger(s[self.to.peak], level), s[self.to.peak])
        s[self.to.level] = where(used, level, s[self.to.level])
        h[CROSSED] = where(used & (level >= 1.0) & (h[CROSSED] <= 0.0), number, h[CROSSED])

    def _speed(self, c: Any, s: Any, source: Any) -> Any:
        k = self.at.velocity  # A (2, 2), B, C, D, steady state
        # not fused: at rest what is left of it is rounding, whose sign must not hang on how the sum is rounded
        return c[k + 8] * source + c[k + 6] * s[self.to.velocity] + c[k + 7] * s[self.to.velocity + 1]

    def _inputs(self, c: Any, r: Any, u: Any, y: Any, speed: Any) -> list[Any]:
        """Return the bank's inputs: r, u within its limits, y, and what friction and offset make of the speed."""
        w = [r, smaller(larger(u, c[self.at.low]), c[self.at.high]), y]
        for kind in self.size.codes:
            if kind == 0:
                w.append(where(abs(speed) <= c[self.at.sign_speed], 0.0, where(speed > 0.0, 1.0, -1.0)))
            elif kind < 3:
                w.append(larger(speed, 0.0) if kind == 1 else smaller(speed, 0.0))
            else:
                w.append(1.0)
        return w

    def _mean(self, c: Any, s: Any, left: Any) -> Any:
        return fma(fma(left, left, -s[self.to.power]), c[self.at.share], s[self.to.power])

    def _carry(self, c: Any, s: Any, h: Any, v: Any, shadow: Any, e: Any, phi: Sequence[Any], K: Sequence[Any]) -> None:
        spread(c, self.at.noise, s, self.to.S, self.size.lags, phi, K)
        if self.size.start:
            remember(s, self.to.Psi, phi, K)
        if self.size.shadow:
            self._whiten(c, s, h, v, shadow, e, phi)

    def _whiten(self, c: Any, s: Any, h: Any, v: Any, shadow: Any, e: Any, phi: Sequence[Any]) -> None:
        """Whiten what the residual has beyond the shadow's, and the shadow's columns; beside them, late copies."""
        n, memory, to = self.size.n, self.size.memory, self.to
        for lag in range(LAGS, 0, -1):
            s[to.psi + n - 1 + lag] = s[to.psi + n - 2 + lag]
        for i in range(n):
            s[to.psi + i] = whitened(c, self.at.white, s, to.white + (1 + i) * memory, memory, shadow[1 + i])
        residual = v[0] - shadow[0] - dot([c[self.at.apart + i] for i in range(n)], phi)
        e[0] = smaller(larger(whitened(c, self.at.white, s, to.white, memory, residual), -CLIP), CLIP)
        h[USED_UP] = h[USED_UP] + 1.0

    def _hand_over(self, s: Any, e: Any, counts: Truth, w: Any, i: Any) -> None:
        """Write columns and residual of sample i to w; no CUSUM moves where all of them are zero."""
        columns = self.size.n + LAGS
        for k in range(columns):
            w[i * (columns + 1) + k] = where(counts, s[self.to.psi + k], 0.0)
        w[i * (columns + 1) + columns] = where(counts, e[0], 0.0)
