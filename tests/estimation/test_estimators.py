"""Contract checks that every recursive estimator passes; a new file in `estimators/` is picked up by its name."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import EntryPoint
from typing import Any

import naive
import numpy as np
import numpy.typing as npt
import pytest
from scipy.signal import lfilter

from servoscope.core.errors import LoopError
from servoscope.core.jit import tril_index
from servoscope.estimation import estimators
from servoscope.estimation.moments import propagate_covariance
from servoscope.estimation.noise_model import ArmaNoise
from servoscope.estimation.update import run_updates

n = 4
R = 0.3
MEMORY = 500.0
ALL = estimators.estimator_names()
WITH_INSTRUMENT = [name for name in ALL if estimators.load_estimator(name).NEEDS_INSTRUMENT]


def spd(seed: int, condition: float = 1e4) -> naive.Array:
    """Return a symmetric positive matrix with eigenvalues between 1/condition and 1."""
    rng = np.random.default_rng(seed)
    Q = np.linalg.qr(rng.standard_normal((n, n)))[0]
    full = np.asarray((Q * np.geomspace(1.0 / condition, 1.0, n)) @ Q.T)
    return (full + full.T) / 2.0


def samples(steps: int, seed: int = 5, mismatch: float = 0.1) -> tuple[naive.Array, naive.Array, naive.Array]:
    """Return eta (N,), and phi and z (N, n) of very different sizes from sample to sample."""
    rng = np.random.default_rng(seed)
    phi = rng.standard_normal((steps, n)) * rng.lognormal(0.0, 1.0, (steps, 1))
    z = phi + mismatch * rng.standard_normal((steps, n))
    return rng.standard_normal(steps), phi, z


class Run:
    """One estimator with its state, started away from P_d."""

    def __init__(
        self, name: str, P: naive.Array | None = None, P_d: naive.Array | None = None, memory: float = MEMORY
    ) -> None:
        self.estimator, self.R, self.memory = estimators.load_estimator(name), R, memory
        self.theta = np.array([1.0, -2.0, 0.5, 3.0])
        self.P = np.array(spd(1) * 7.0 if P is None else P)
        self.P_d = np.array(spd(2) if P_d is None else P_d)
        self.K = np.full(n, np.nan)
        self.extra = np.zeros(estimators.extra_state_size(name, n, memory))

    def state(self) -> bytes:
        return b"".join(each.tobytes() for each in (self.theta, self.P, self.extra))

    def step(self, eta: float, phi: naive.Array, z: naive.Array | None = None) -> int:
        return self.steps(np.array([eta]), phi[None], phi[None] if z is None else z[None])

    def steps(
        self, eta: naive.Array, phi: naive.Array, z: naive.Array, count: int = 0, on: int = 1, off: int = 0
    ) -> int:
        """Go through the samples, or through `count` repeated ones; return how many were skipped.

        `on` of `on + off` of them move.
        """
        state, skipped = (self.theta, self.P, self.P_d, self.R, self.memory), 0
        for begin in range(0, count or len(eta), len(eta)):
            number = begin + np.arange(min(len(eta), (count or len(eta)) - begin))
            moves = (number % (on + off) < on)[:, None]
            signals = eta[: len(number)], moves * phi[: len(number)], moves * z[: len(number)]
            skipped += run_updates(self.estimator, *state, *signals, self.K, self.extra)
        return skipped


def assert_positive(P: npt.NDArray[Any]) -> None:
    assert np.array_equal(P, P.T)
    assert np.linalg.eigvalsh(P.astype(np.float64)).min() > 0.0


# How the samples move: `on` of `on + off` of them do. A rest of two memories is longer than a sliding window.
MOTION = {"moves": (1, 0), "rests": (0, 1), "comes and goes": (1000, 1000)}


def check_positive(name: str) -> None:
    keeps_samples = (
        estimators.extra_state_size(name, n, MEMORY) > MEMORY
    )  # and nothing older: 10 times fewer steps say as much
    count = 1_000_000 if keeps_samples else 10_000_000
    for on, off in MOTION.values():
        run = Run(name)
        for _ in range(20):
            run.steps(*samples(4099), count // 20, on, off)
            assert np.all(np.isfinite(run.theta)) and np.all(np.isfinite(run.P))
            assert_positive(run.P)


def check_no_windup(name: str) -> None:
    run, before, zero = Run(name), Run(name), np.zeros((10_000, n))
    run.steps(np.full(10_000, 3.0), zero, zero, 1_000_000)
    assert np.array_equal(run.P, before.P)
    assert np.array_equal(run.theta, before.theta)
    assert np.array_equal(run.K, np.zeros(n))


def check_contracts(name: str) -> None:
    run = Run(name, P=np.diag([5.0, 0.2, 7.0, 3.0]), P_d=np.diag([1.0, 2.0, 0.5, 0.1]))
    gap = []
    for k in range(400):
        phi = np.eye(n)[k % 2] * 0.7
        e_p = run.P - run.P_d
        A_P, A_d = (np.eye(n) + np.outer(M @ phi, phi) / R for M in (run.P, run.P_d))
        run.step(0.0, phi)
        # eq. (12), which is exact
        assert np.abs(run.P - run.P_d - np.linalg.solve(A_P, e_p) @ np.linalg.inv(A_d).T).max() < 1e-14
        gap.append(np.abs(np.diag(run.P - run.P_d))[:2].max())
    assert np.all(np.diff(gap[::2]) <= 0.0)
    # near P_d a sample along its axis leaves 1/(1 + 0.49 P_d/R)^2 of a gap: 14 % of the first one, 5 % of the second
    assert gap[12] / gap[10] == pytest.approx((1.0 + 0.49 / R) ** -2, rel=1e-3)
    assert gap[-1] < 1e-9
    assert np.array_equal(np.diag(run.P)[2:], [7.0, 3.0])
    fixed = Run(name, P=spd(2))
    fixed.steps(samples(500)[0], samples(500)[1], samples(500)[1])
    assert np.abs(fixed.P - fixed.P_d).max() < 1e-12


def check_covariance(name: str) -> None:
    """Scatter of theta_hat over many realisations of coloured noise against S, when excitation comes and goes."""
    memory, steps, a, b = 200.0, 1100, 0.8, -0.3
    variance = R * (1.0 - a**2) / (1.0 + 2.0 * a * b + b**2)  # of e in v(k) = a v(k-1) + e(k) + b e(k-1)
    rng, runs, settled = np.random.default_rng(4), [], 100
    phi = rng.standard_normal((steps, n)) @ np.linalg.cholesky(spd(3, 100.0)).T
    phi[np.arange(steps) % 300 >= 150] *= 1e-3
    P_d = R / memory * np.linalg.inv(phi.T @ phi / steps)
    lags, heads = ArmaNoise(np.array([a]), np.array([b]), np.array([R]), variance).chain()
    model, state = [R, *lags, *heads], dict.fromkeys(range(n * (n + 1) // 2 + n), 0.0)
    tracked = Run(name, P_d, P_d, memory)
    for k in range(steps):
        tracked.step(0.0, phi[k])
        propagate_covariance(model, 0, state, 0, 1, phi[k], tracked.K)
    S = np.array([[state[tril_index(i, j)] for j in range(n)] for i in range(n)])
    for _ in range(1500):
        white = rng.standard_normal(settled + steps) * np.sqrt(variance)
        run = Run(name, P_d, P_d, memory)
        run.theta[:] = 0.0
        run.steps(lfilter([1.0, b], [1.0, -a], white)[settled:], phi, phi)
        runs.append(run.theta)
    L = np.linalg.inv(np.linalg.cholesky(S))
    ratios = np.linalg.eigvalsh(L @ np.cov(np.array(runs).T) @ L.T)
    assert ratios.min() > 0.8 and ratios.max() < 1.25, ratios


def check_mean(name: str) -> None:
    run, P_d = Run(name, P=spd(2)), spd(2)
    for eta, phi in zip(*samples(2000)[:2], strict=True):
        run.step(eta, phi)
        assert np.allclose(run.K, P_d @ phi / (R + phi @ P_d @ phi), rtol=1e-9, atol=1e-12)


def check_textbook(name: str) -> None:
    run = Run(name, memory=50.0)
    theta, P, updated, past = run.theta.copy(), run.P.copy(), 0, list[Any]()
    for eta, phi, z in zip(*samples(300), strict=True):
        status = run.step(eta, phi, z)
        theta, P, K = naive.UPDATES[name](theta, P, run.P_d, R, eta, phi, z, 50.0, past)
        assert (status == 0) == bool(np.any(K))
        updated += status == 0
        scale = np.abs(P).max()
        assert np.abs(run.P - P).max() < 1e-10 * scale
        assert run.theta == pytest.approx(theta, rel=1e-10, abs=1e-10)
        assert pytest.approx(K, rel=1e-10, abs=1e-10) == run.K
    assert updated > 200


def check_converges(name: str) -> None:
    run, truth = Run(name), np.array([0.3, 1.0, -1.0, 2.0])
    _, phi, z = samples(30_000)
    run.steps(phi @ truth, phi, z)
    assert run.theta == pytest.approx(truth, abs=1e-4)


def share_left(name: str, shape: naive.Array, updates: int) -> naive.Array:
    """Return what is left of each direction of a change after so many updates, noise-free, P_d tuned as usual."""
    left = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        phi = rng.standard_normal((4 * round(MEMORY), n)) @ shape.T
        run = Run(name, *[R / MEMORY * np.linalg.inv(shape @ shape.T)] * 2)
        run.theta[:] = 0.0
        run.steps(np.zeros(len(phi)), phi, phi)
        truth = np.linalg.solve(shape.T, np.ones(n))
        run.steps(phi[:updates] @ truth, phi[:updates], phi[:updates])
        left.append(shape.T @ (truth - run.theta))
    return np.asarray(np.mean(left, axis=0))


def check_memory(name: str) -> None:
    assert share_left(name, np.eye(n), round(MEMORY)) == pytest.approx(np.exp(-1.0), abs=0.03)


def check_memory_in_weak_directions(name: str) -> None:
    Q = np.linalg.qr(np.random.default_rng(3).standard_normal((n, n)))[0]
    left = share_left(name, Q * np.geomspace(1e-3, 1.0, n), round(MEMORY))
    assert left == pytest.approx(np.exp(-1.0), abs=0.03)


def check_private_state(name: str) -> None:
    """Two runs that take turns end where each ends alone."""
    alone, first, second = Run(name, memory=20.0), Run(name, memory=20.0), Run(name, P=np.eye(n))
    P_d = first.P_d.copy()
    alone.steps(*samples(50))
    for (eta, phi, z), other in zip(zip(*samples(50), strict=True), zip(*samples(50, 9), strict=True), strict=True):
        kept = phi.copy(), z.copy()
        first.step(eta, phi, z)
        second.step(*other)
        assert np.array_equal(phi, kept[0]) and np.array_equal(z, kept[1])
    for mine, theirs in ((first.theta, alone.theta), (first.P, alone.P), (first.extra, alone.extra)):
        assert np.array_equal(mine, theirs)
    assert np.array_equal(first.P_d, P_d)


def test_names_and_oracles() -> None:
    assert set(ALL) == set(naive.UPDATES), "every estimator has its textbook version in naive.py"
    for name in ALL:
        assert name == estimators.load_estimator(name).NAME
    assert estimators.extra_state_size("akf", n, MEMORY) == 0
    with pytest.raises(LoopError, match="choose from akf"):
        estimators.load_estimator("kalmann")


def test_another_package_adds_an_estimator_by_an_entry_point(monkeypatch: pytest.MonkeyPatch) -> None:
    entry = EntryPoint("outside", "servoscope.estimation.estimators.akf", estimators.GROUP)
    monkeypatch.setattr(
        estimators.metadata, "entry_points", lambda group, name=None: [entry] if name in (None, "outside") else []
    )
    assert "outside" in estimators.estimator_names()
    assert estimators.load_estimator("outside").NAME == "akf"
    assert estimators.extra_state_size("outside", n, MEMORY) == 0


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("check", estimators.CHECKS)
def test_passes_the_check_or_says_why_not(name: str, check: str) -> None:
    """An exception that is not needed fails, as does one without a reason or of an unknown check."""
    reasons = estimators.exceptions(name)
    assert set(reasons) <= set(estimators.CHECKS) and all(len(reason) > 30 for reason in reasons.values())
    run: Callable[[str], None] = globals()[f"check_{check.replace(' ', '_')}"]
    if check in reasons:
        with pytest.raises(AssertionError):
            run(name)
    else:
        run(name)


@pytest.mark.parametrize("name", WITH_INSTRUMENT)
class TestInstrument:
    def test_no_sample_is_chosen_by_the_sign_of_its_regressor(self, name: str) -> None:
        """Samples whose noise turns phi around belong to the mean: without them the estimate is biased."""
        run, before = Run(name), Run(name)
        phi = np.array([1.0, 2.0, -1.0, 0.5])
        assert run.step(4.0, -phi, phi) == 0
        assert not np.array_equal(run.theta, before.theta)
        assert np.array_equal(run.P, run.P.T)

    def test_an_estimate_that_runs_away_stops_before_it_overflows(self, name: str) -> None:
        run, (eta, phi, _) = Run(name, memory=20.0), samples(20_000)
        refused = run.steps(eta, phi, -phi)
        assert refused > 10_000
        assert np.all(np.isfinite(run.theta)) and np.abs(run.theta).max() < 1e9
        assert np.all(np.isfinite(run.P)) and np.abs(run.P).max() < 100.0

    def test_instrument_removes_the_bias_of_a_noisy_regressor(self, name: str) -> None:
        truth, rng = np.array([0.3, 1.0, -1.0, 2.0]), np.random.default_rng(1)
        clean = rng.standard_normal((60_000, n))
        noisy = clean + 0.5 * rng.standard_normal(clean.shape)
        P_d = 1e-4 * np.eye(n)
        with_z, without = Run(name, P_d, P_d), Run("akf", P_d, P_d)
        average = np.zeros((2, n))
        for k, (x, phi) in enumerate(zip(clean, noisy, strict=True)):
            for run, z in ((with_z, x), (without, phi)):
                run.step(float(x @ truth), phi, z)
            if k >= 40_000:
                average += np.array([with_z.theta, without.theta]) / 20_000
        assert average[1] == pytest.approx(truth / 1.25, abs=0.03)
        assert average[0] == pytest.approx(truth, abs=0.03)
