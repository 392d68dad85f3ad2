"""Stage 1 of the closed-loop identification: r -> u estimated recursively, u_a = S_hat r simulated with it.

In a closed loop the measured u carries the noise of y through the controller. Van den Hof and Schrama (1993) first
estimate the sensitivity r -> u, which r alone excites, and put its noise-free output u_a in the place of u. Here the
map is a sum of FIR taps or Laguerre functions of r, and its weights are estimated by the same estimators as the
inverse model's.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from servoscope import estimators, straight
from servoscope.arithmetic import dot, fma
from servoscope.errors import NotEnoughError
from servoscope.linear import Linear, taps
from servoscope.plants import FloatArray
from servoscope.recording import Recording

if TYPE_CHECKING:
    from servoscope.loop import Loop
    from servoscope.recursion import BoolArray

LENGTHS = {"fir": 40, "laguerre": 12}  # functions, where a loop file does not say
RIDGE = 1e-4  # of the mean excitation: what r excites less is not learned, and adds no noise to u_a
FORGOTTEN = 1e-3  # share of a start-up transient that is let through
WIDE = 8  # numbers in a vector
ARMED, WAIT = range(2)  # counters at the head of the state row
HEAD = 2


@dataclass(frozen=True)
class StageOne:
    """What healthy recordings say of r -> u: where stage 1 starts, and how it is tuned.

    Parameters
    ----------
    theta
        Weights of the functions, shape (n,).
    P_d
        Desired covariance, shape (n, n).
    R
        Variance of what u has beside u_a.
    """

    theta: tuple[float, ...]
    P_d: tuple[tuple[float, ...], ...]
    R: float


class Constants(NamedTuple):
    """What the compiled stage takes: the functions of r as a linear system, and the tuning.

    `functions` are the `straight.coefficients` of the system, X0 its steady state; P_d is filled up with zeros to whole
    vectors.
    """

    functions: FloatArray
    X0: FloatArray
    limits: FloatArray
    wait: int
    theta: FloatArray
    P_d: FloatArray
    R: float
    memory: float


def functions(loop: Loop) -> Linear:
    """Return the functions of r that stage 1 weighs, as one system from r to n outputs.

    FIR: r(k), r(k-1), ...; Laguerre (Wahlberg, 1991), orthonormal, of pole a and with feedthrough, for u answers r
    within the sample: ``L_0 = sqrt(1 - a^2)/(1 - a q)``, ``L_i = L_(i-1) (q - a)/(1 - a q)``.
    """
    settings = loop.monitor
    n = settings.stage_one_length or LENGTHS[settings.stage_one]
    if settings.stage_one == "fir":
        return taps(np.eye(n))
    a = settings.stage_one_pole
    # the states are the outputs one sample ago: l_i(k) = a l_i(k-1) + l_(i-1)(k-1) - a l_(i-1)(k)
    M, m = np.zeros((n, n)), np.zeros((n, 1))
    M[0, 0], m[0, 0] = a, np.sqrt(1.0 - a * a)
    for i in range(1, n):
        M[i], m[i] = -a * M[i - 1], -a * m[i - 1]
        M[i, i] += a
        M[i, i - 1] += 1.0
    return Linear(M, m, M, m)


def settling(system: Linear) -> int:
    """Count the samples after which the functions have forgotten what was before them."""
    power, count = np.eye(len(system.A)), 0
    while np.abs(power).max(initial=0.0) > FORGOTTEN:
        power, count = system.A @ power, count + 1
    return count


class Stage:
    """Stage 1 of one loop, ready to run; without two stages it lets u pass and has no state.

    Parameters
    ----------
    loop
        Its monitor settings say which functions, which estimator and which memory.
    tuning
        None: u passes.
    """

    def __init__(self, loop: Loop, tuning: StageOne | None) -> None:
        self.size = 0
        if tuning is None:
            return
        system = functions(loop)
        infinite = (-np.inf, np.inf)
        limits = (loop.input_limits or infinite) if loop.input_logged == "before_limiter" else infinite
        found, P_d = straight.pattern([system]), np.array(tuning.P_d)
        arrays = {
            **{"functions": straight.coefficients(found, system), "X0": system.steady[:, 0]},
            **{
                "limits": limits,
                "theta": tuning.theta,
                "P_d": _filled(P_d),
            },
        }
        self._constants = Constants(
            **{name: np.ascontiguousarray(value, dtype=np.float64) for name, value in arrays.items()},
            wait=settling(system),
            R=tuning.R,
            memory=loop.monitor.memory * loop.sample_rate,
        )
        n, name = len(tuning.theta), loop.monitor.estimator
        self._steady = hasattr(estimators.load(name), "steady")
        self._P = 0 if self._steady else n * n
        self.size = HEAD + len(system.A) + n + self._P + estimators.extra(name, n, self._constants.memory)
        self._block = block(name, found)

    def start(self) -> FloatArray:
        """Return the state before the first sample, shape (size,)."""
        if not self.size:
            return np.zeros(0)
        c = self._constants
        P = np.zeros(0) if self._steady else c.P_d[: len(c.theta), : len(c.theta)].ravel()
        used = np.concatenate([np.zeros(HEAD + len(c.X0)), c.theta, P])
        return np.pad(used, (0, self.size - len(used)))

    def run(self, state: FloatArray, r: FloatArray, u: FloatArray, restart: BoolArray) -> FloatArray:
        """Return u_a of a block, shape (N,), and change `state` (size,) in place.

        u_a(k) is what the estimate of sample k - 1 says, so that the noise of u(k) has no share in it. It is NaN where
        r or u is, and after a gap until the functions have forgotten it: stage 2 waits there too.
        """
        if not self.size:
            return u
        u_a = np.empty(len(r))
        self._block(self._constants, state, r, u, restart, u_a)
        return u_a


def tune(loop: Loop, recordings: Sequence[Recording]) -> StageOne | None:
    """Tune stage 1 on healthy recordings as stage 2 is: start at least squares, P_d = (R/N) R_phi^-1.

    R_phi gets a small ridge: r excites some combinations of its own past hardly at all.

    Returns
    -------
    StageOne or None
        None for a loop with ``two_stage = "none"``.

    Raises
    ------
    NotEnoughError
        If r does not move, or too few samples are left when the functions have settled.
    """
    if loop.monitor.two_stage == "none":
        return None
    system = functions(loop)
    wait, n = settling(system), len(system.C)
    phi, u = [], []
    for recording in recordings:
        ends = [*np.flatnonzero(recording.restart)[1:], recording.samples]
        for begin, end in zip(np.flatnonzero(recording.restart), ends, strict=True):
            phi.append(system.simulate(recording.r[begin:end, None])[wait:])
            u.append(recording.u[begin + wait : end])
    Phi, eta = np.vstack(phi), np.concatenate(u)
    if len(eta) < 2 * n:
        raise NotEnoughError(
            f"only {len(eta)} usable samples for the {n} functions of stage 1: record longer, or lower "
            "[monitor] stage_one_length"
        )
    R_phi = Phi.T @ Phi / len(eta)
    excitation = float(np.trace(R_phi)) / n
    if not excitation > 0.0:
        raise NotEnoughError("stage 1 learns nothing: the reference is zero throughout the healthy recordings")
    R_phi = R_phi + RIDGE * excitation * np.eye(n)
    theta = np.linalg.solve(R_phi, Phi.T @ eta / len(eta))
    R = max(float(np.mean((eta - Phi @ theta) ** 2)), 1e-12 * float(np.mean(eta**2)))
    P_d = R / (loop.monitor.memory * loop.sample_rate) * np.linalg.inv(R_phi)
    P_d = (P_d + P_d.T) / 2.0
    return StageOne(tuple(theta.tolist()), tuple(tuple(row) for row in P_d.tolist()), R)


# what the templates are filled with: sizes, arrays of fixed shape, and as code the functions of r, products of vectors,
# and how theta is updated
_states: Any = None
_padded: Any = None
_laid: Any = None
_functions: Any = None
_products: Any = None
_column: Any = None
_steady: Any = None
_learn: Any = None
_update: Any = None


def settled(
    c: Constants, s: FloatArray, theta: FloatArray, phi: FloatArray, K: FloatArray, sums: FloatArray, eta: float
) -> None:
    """Update theta where P stays at P_d: K = P_d phi/(R + phi' P_d phi)."""
    strength, left = c.R, eta
    for i in range(WIDE):
        left -= sums[i]
        strength += sums[WIDE + i]
    step = left / strength
    for i in range(len(theta)):
        theta[i] += K[i] * step


def refreshed(
    c: Constants, s: FloatArray, theta: FloatArray, phi: FloatArray, K: FloatArray, sums: FloatArray, eta: float
) -> None:
    """Update theta and P by any estimator."""
    n = len(c.theta)
    P = s[HEAD + _states + n : HEAD + _states + n + n * n].reshape((n, n))
    extra = s[HEAD + _states + n + n * n :]
    _update(theta[:n], P, c.P_d[:n, :n], c.R, c.memory, eta, phi[:n], phi[:n], K[:n], extra)


def stage(c: Constants, s: FloatArray, r: FloatArray, u: FloatArray, restart: BoolArray, u_a: FloatArray) -> None:
    """Write u_a of a block."""
    n = len(c.theta)
    x = _laid(s[HEAD : HEAD + _states], 1, 1)
    weights, P_d = _laid(c.functions, 1, 1), _laid(c.P_d.reshape(c.P_d.size), WIDE, 1)
    w, phi, K, theta, sums = (
        np.empty((1, 1)),
        np.zeros(_padded),
        np.zeros(_padded),
        np.zeros(_padded),
        np.zeros(2 * WIDE),
    )
    theta[:n] = s[HEAD + _states : HEAD + _states + n]
    one, wide, weight, gain = _laid(phi, 1, 1), _laid(phi, WIDE, 1), _laid(theta, WIDE, 1), _laid(K, WIDE, 1)
    parts = _laid(sums, WIDE, 1)
    for k in range(len(r)):
        u_a[k] = np.nan
        if not (np.isfinite(r[k]) and np.isfinite(u[k])):
            s[ARMED] = 0.0
            continue
        if restart[k] or s[ARMED] == 0.0:
            s[ARMED] = 1.0
            s[WAIT] = c.wait
            for i in range(_states):
                x[i, 0] = c.X0[i] * r[k]
        w[0, 0] = r[k]
        _functions(0, weights, x, w, one)
        if s[WAIT] > 0.0:
            s[WAIT] -= 1.0
            continue
        if _steady:
            K[:] = 0.0
            for j in range(0, _padded, WIDE):
                _column(0, P_d, one, gain, j)
        _products(0, wide, weight, gain, parts)
        total = 0.0
        for i in range(WIDE):
            total += sums[i]
        u_a[k] = total
        _learn(c, s, theta, phi, K, sums, min(max(u[k], c.limits[0]), c.limits[1]))
    s[HEAD + _states : HEAD + _states + n] = theta[:n]


@functools.cache
def block(estimator: str, found: straight.Pattern) -> Callable[..., None]:
    """Compile stage 1 around one estimator and the functions of r: ``block(c, state, r, u, restart, u_a)``."""
    from servoscope.compiled import filled, inlined, kernel, laid, traced

    tools, n = estimators.load(estimator), len(found[0])
    steady, rows = hasattr(tools, "steady"), _rows(n)

    def functions(c: Any, s: Any, w: Any, v: Any) -> None:
        for i, number in enumerate(straight.advance(found, c, 0, s, 0, [w[0]])):
            v[i] = number

    def column(P_d: Any, one: Any, K: Any, j: Any) -> None:
        """Add so many columns of P_d as a vector is wide, each times its phi, to K."""
        for i in range(rows):
            total = K[i]
            for k in range(WIDE):
                total = fma(P_d[j * rows + (k * rows + i)], one[j + k], total)
            K[i] = total

    def products(phi: Any, theta: Any, K: Any, sums: Any) -> None:
        """Write the products phi' theta and phi' K, in as many parts as a vector is wide."""
        for place, other in enumerate((theta, K)):
            sums[place] = dot([phi[i] for i in range(rows)], [other[i] for i in range(rows)])

    names: dict[str, object] = {
        "_states": len(found[1]),
        "_padded": rows * WIDE,
        "_update": tools.update,
        "_laid": laid,
        "_steady": steady,
    }
    names |= {
        "_functions": traced(functions),
        "_products": traced(products, WIDE),
        "_column": traced(column, WIDE, "one"),
    }
    names["_learn"] = inlined(filled(settled if steady else refreshed, names), heap=True)
    return kernel(filled(stage, names, repr((estimator, found))))


def _filled(P_d: FloatArray) -> FloatArray:
    """Return a matrix filled up with zeros to whole vectors, in both directions."""
    return np.pad(P_d, (0, _rows(len(P_d)) * WIDE - len(P_d)))


def _rows(n: int) -> int:
    """Return how many vectors n numbers take."""
    return -(-n // WIDE)
