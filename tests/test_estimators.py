"""Contract checks that every recursive estimator passes; a new file in `estimators/` is picked up by its name."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import naive
from servoscope import estimators
from servoscope.errors import LoopError

n = 4
R = 0.3
MEMORY = 500.0
ALL = estimators.names()
WITH_INSTRUMENT = [name for name in ALL if estimators.load(name).NEEDS_INSTRUMENT]


def spd(seed: int, condition: float = 1e4) -> naive.Array:
    """Return a symmetric positive matrix with eigenvalues between 1/condition and 1."""
    rng = np.random.default_rng(seed)
    Q = np.linalg.qr(rng.standard_normal((n, n)))[0]
    return np.asarray((Q * np.geomspace(1.0 / condition, 1.0, n)) @ Q.T)


class Run:
    """One estimator with its state, started away from P_d."""

    def __init__(self, name: str, P: naive.Array | None = None, P_d: naive.Array | None = None) -> None:
        self.update: Any = estimators.load(name).update
        self.theta = np.array([1.0, -2.0, 0.5, 3.0])
        self.P = spd(1) * 7.0 if P is None else P.copy()
        self.P_d = spd(2) if P_d is None else P_d
        self.K = np.full(n, np.nan)

    def step(self, eta: float, phi: naive.Array, z: naive.Array | None = None) -> int:
        z = phi if z is None else z
        return int(self.update(self.theta, self.P, self.P_d, R, MEMORY, eta, phi, z, self.K))


def samples(steps: int, seed: int = 5, mismatch: float = 0.1) -> list[tuple[float, naive.Array, naive.Array]]:
    rng = np.random.default_rng(seed)
    phi = rng.standard_normal((steps, n)) * rng.lognormal(0.0, 1.0, (steps, 1))
    z = phi + mismatch * rng.standard_normal((steps, n))
    return list(zip(rng.standard_normal(steps).tolist(), phi, z, strict=True))


def test_names_and_oracles() -> None:
    assert set(ALL) == set(naive.UPDATES), "every estimator has its textbook version in naive.py"
    for name in ALL:
        assert name == estimators.load(name).NAME
    with pytest.raises(LoopError, match="choose from akf"):
        estimators.load("kalmann")


@pytest.mark.parametrize("name", ALL)
class TestContract:
    def test_equals_the_textbook(self, name: str) -> None:
        run = Run(name)
        theta, P, updated = run.theta.copy(), run.P.copy(), 0
        for eta, phi, z in samples(300):
            status = run.step(eta, phi, z)
            theta, P, K = naive.UPDATES[name](theta, P, run.P_d, R, eta, phi, z)
            assert (status == 0) == bool(np.any(K))
            updated += status == 0
            scale = np.abs(P).max()
            assert np.abs(run.P - P).max() < 1e-12 * scale
            assert run.theta == pytest.approx(theta, rel=1e-12, abs=1e-12)
            assert pytest.approx(K, rel=1e-12, abs=1e-12) == run.K
        assert updated > 200

    def test_no_excitation_no_windup(self, name: str) -> None:
        run, before = Run(name), Run(name)
        zero = np.zeros(n)
        for k in range(20_000):
            run.step(float(k % 7), zero)
        assert np.array_equal(run.P, before.P)
        assert np.array_equal(run.theta, before.theta)
        assert np.array_equal(run.K, zero)

    def test_P_contracts_to_P_d_along_excited_directions_only(self, name: str) -> None:
        run = Run(name, P=np.diag([5.0, 0.2, 7.0, 3.0]), P_d=np.diag([1.0, 2.0, 0.5, 0.1]))
        gap = []
        for k in range(400):
            phi = np.eye(n)[k % 2] * 0.7
            run.step(0.0, phi)
            gap.append(np.abs(np.diag(run.P - run.P_d))[:2].max())
        assert np.all(np.diff(gap[::2]) <= 0.0)
        assert gap[-1] < 1e-9
        assert np.array_equal(np.diag(run.P)[2:], [7.0, 3.0])

    def test_P_d_is_a_fixed_point(self, name: str) -> None:
        run = Run(name, P=spd(2))
        for eta, phi, _ in samples(500):
            run.step(eta, phi)
        assert np.abs(run.P - run.P_d).max() < 1e-12

    def test_finds_theta(self, name: str) -> None:
        run, truth = Run(name), np.array([0.3, 1.0, -1.0, 2.0])
        for _, phi, z in samples(30_000):
            run.step(float(phi @ truth), phi, z)
        assert run.theta == pytest.approx(truth, abs=1e-4)

    def test_has_no_hidden_state_and_leaves_its_inputs(self, name: str) -> None:
        """Two runs that take turns end where each ends alone."""
        alone, first, second = Run(name), Run(name), Run(name, P=np.eye(n))
        P_d = first.P_d.copy()
        for eta, phi, z in samples(50):
            alone.step(eta, phi, z)
        for (eta, phi, z), (other_eta, other_phi, other_z) in zip(samples(50), samples(50, seed=9), strict=True):
            kept = phi.copy(), z.copy()
            first.step(eta, phi, z)
            second.step(other_eta, other_phi, other_z)
            assert np.array_equal(phi, kept[0]) and np.array_equal(z, kept[1])
        assert np.array_equal(first.theta, alone.theta)
        assert np.array_equal(first.P, alone.P)
        assert np.array_equal(first.P_d, P_d)


@pytest.mark.parametrize("name", sorted(set(ALL) - set(WITH_INSTRUMENT)))
def test_P_stays_symmetric_and_positive(name: str) -> None:
    run = Run(name)
    for eta, phi, z in samples(20_000):
        run.step(eta, phi, z)
    assert np.array_equal(run.P, run.P.T)
    assert np.linalg.eigvalsh(run.P).min() > 0.0


@pytest.mark.parametrize("name", WITH_INSTRUMENT)
class TestInstrument:
    def test_skips_where_the_instrument_points_away(self, name: str) -> None:
        run, before = Run(name), Run(name)
        phi = np.array([1.0, 2.0, -1.0, 0.5])
        assert run.step(4.0, phi, -phi) == 1
        assert np.array_equal(run.theta, before.theta)
        assert np.array_equal(run.P, before.P)
        assert np.array_equal(run.K, np.zeros(n))
        assert run.step(4.0, phi, phi) == 0

    def test_stays_bounded_with_a_poor_instrument(self, name: str) -> None:
        run, skipped = Run(name), 0
        for eta, phi, z in samples(20_000, mismatch=1.0):
            skipped += run.step(eta, phi, z)
        assert 100 < skipped < 19_000
        assert np.all(np.isfinite(run.P)) and np.abs(run.P).max() < 100.0
        assert np.abs(run.theta).max() < 100.0

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
