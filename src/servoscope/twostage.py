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

from servoscope import estimators
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
    """What the compiled stage takes: the functions of r as a linear system (A, B, C, D, steady X0), and the tuning."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
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
        arrays = {
            **{"A": system.A, "B": system.B, "C": system.C, "D": system.D, "X0": system.steady},
            **{"limits": limits, "theta": tuning.theta, "P_d": tuning.P_d},
        }
        self._constants = Constants(
            **{name: np.ascontiguousarray(value, dtype=np.float64) for name, value in arrays.items()},
            wait=settling(system),
            R=tuning.R,
            memory=loop.monitor.memory * loop.sample_rate,
        )
        n = len(tuning.theta)
        extra = estimators.extra(loop.monitor.estimator, n, self._constants.memory)
        self.size = HEAD + len(system.A) + n + n * n + extra
        self._block = block(loop.monitor.estimator)

    def start(self) -> FloatArray:
        """Return the state before the first sample, shape (size,)."""
        if not self.size:
            return np.zeros(0)
        c = self._constants
        used = HEAD + len(c.A) + len(c.theta) + c.P_d.size
        return np.concatenate([np.zeros(HEAD + len(c.A)), c.theta, c.P_d.ravel(), np.zeros(self.size - used)])

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


def _update(*_: Any) -> int:  # the template's placeholder: `block` is built with an estimator in its place
    return 0


def _stage_one(c: Constants, s: FloatArray, r: FloatArray, u: FloatArray, restart: BoolArray, u_a: FloatArray) -> None:
    nx = c.A.shape[0]
    n = len(c.theta)
    x = s[HEAD : HEAD + nx]
    theta = s[HEAD + nx : HEAD + nx + n]
    P = s[HEAD + nx + n : HEAD + nx + n + n * n].reshape((n, n))
    extra = s[HEAD + nx + n + n * n :]
    phi = np.empty(n)
    K = np.empty(n)
    new = np.empty(nx)
    for k in range(len(r)):
        u_a[k] = np.nan
        if not (np.isfinite(r[k]) and np.isfinite(u[k])):
            s[ARMED] = 0.0
            continue
        if restart[k] or s[ARMED] == 0.0:
            s[ARMED] = 1.0
            s[WAIT] = c.wait
            for i in range(nx):
                x[i] = c.X0[i, 0] * r[k]
        for i in range(n):
            phi[i] = c.D[i, 0] * r[k]
            for j in range(nx):
                phi[i] += c.C[i, j] * x[j]
        for i in range(nx):
            new[i] = c.B[i, 0] * r[k]
            for j in range(nx):
                new[i] += c.A[i, j] * x[j]
        for i in range(nx):
            x[i] = new[i]
        if s[WAIT] > 0.0:
            s[WAIT] -= 1.0
            continue
        u_a[k] = 0.0
        for i in range(n):
            u_a[k] += phi[i] * theta[i]
        _update(theta, P, c.P_d, c.R, c.memory, min(max(u[k], c.limits[0]), c.limits[1]), phi, phi, K, extra)


@functools.cache
def block(estimator: str) -> Callable[..., None]:
    """Compile stage 1 around one estimator: ``block(c, state, r, u, restart, u_a)``."""
    from servoscope.compiled import around

    return around(estimators.load(estimator), _stage_one)
