"""Least squares with columns of very different units, and integrals of posteriors: against numpy and known curves."""

from __future__ import annotations

import numpy as np
import pytest

from servoscope.isolation.ml.least_squares import (
    explained_sum_of_squares,
    last_unknown_std,
    orthonormal_basis,
    solve_least_squares,
)
from servoscope.isolation.posterior import Posterior

rng = np.random.default_rng(5)
J = rng.standard_normal((40, 3)) * np.array([1e-9, 1.0, 1e12])  # as pressures beside displacements
e = rng.standard_normal(40)


class TestColumns:
    def test_solution_is_that_of_the_scaled_problem(self) -> None:
        scale = np.linalg.norm(J, axis=0)
        wanted = -np.linalg.lstsq(J / scale, e, rcond=None)[0] / scale
        step, left = solve_least_squares(J, e)
        assert step == pytest.approx(wanted)
        assert left == pytest.approx(float(((e + J @ wanted) ** 2).sum()))
        assert explained_sum_of_squares(J, e) == pytest.approx(float(e @ e) - left)

    def test_deviation_of_the_last_unknown(self) -> None:
        small = J * np.array([1e9, 1.0, 1e-12])  # where the plain inverse can be trusted
        assert last_unknown_std(small) == pytest.approx(float(np.sqrt(np.linalg.inv(small.T @ small)[2, 2])))
        assert last_unknown_std(np.column_stack([e, 2.0 * e])) > 1e10  # the other says the same

    def test_what_says_nothing_new_is_no_basis(self) -> None:
        Q = orthonormal_basis(np.column_stack([J, J @ np.array([1e9, -2.0, 1e-12]), np.zeros(40)]))
        assert Q.shape == (40, 3)
        np.testing.assert_allclose(Q.T @ Q, np.eye(3), atol=1e-12)


class TestPosterior:
    def test_a_gaussian(self) -> None:
        x = np.linspace(-6.0, 6.0, 121)
        found = Posterior.from_log_density(x, 700.0 - 0.5 * x**2)  # no overflow
        assert found.log_area == pytest.approx(700.0 + 0.5 * np.log(2.0 * np.pi), abs=2e-3)
        assert found.interval == pytest.approx((-1.96, 1.96), abs=0.01)

    def test_what_is_impossible_counts_nothing(self) -> None:
        x = np.linspace(-1.0, 1.0, 41)
        found = Posterior.from_log_density(x, np.where(x < 0.0, -np.inf, 0.0))
        assert found.log_area == pytest.approx(0.0, abs=0.02)
        assert found.interval == pytest.approx((0.025, 0.975), abs=0.02)
