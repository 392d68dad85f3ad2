"""H_hat(f) and its confidence ellipses."""

from __future__ import annotations

from typing import Any

import naive
import numpy as np
import pytest

from servoscope.estimation.filter_bank import build_filter_bank
from servoscope.estimation.frequency_response import frequency_response
from servoscope.models.loop import Loop

FREQUENCIES = (0.3, 1.0, 10.0, 20.0)


def test_is_the_polynomial_at_j_omega(rig: dict[str, Any]) -> None:
    bank = build_filter_bank(Loop.from_dict(rig))
    theta = np.random.default_rng(0).standard_normal((2, 3, 4)) * [1.0, 1e-2, 1e-4, 1e-6]
    H = frequency_response(bank, FREQUENCIES, theta, np.zeros((2, 3, 4, 4))).H
    assert H.shape == (2, 3, 4)
    for i, f in enumerate(FREQUENCIES):
        s = 2j * np.pi * f
        by_hand = theta[..., 0] + theta[..., 1] * s + theta[..., 2] * s**2 + theta[..., 3] * s**3
        assert H[..., i] == pytest.approx(by_hand, rel=1e-12)


@pytest.mark.parametrize("structure", ["svf", "tustin"])
def test_covariance_and_ellipses_describe_the_scatter(rig: dict[str, Any], structure: str) -> None:
    loop = Loop.from_dict(rig | {"monitor": {"structure": structure}})
    bank = build_filter_bank(loop)
    rng = np.random.default_rng(1)
    size = np.array([1.0, 1e-2, 1e-4, 1e-6]) if structure == "svf" else np.ones(4)
    L = rng.standard_normal((4, 4)) * size[:, None]
    covariance = L @ L.T
    draws = rng.standard_normal((20_000, 4)) @ L.T
    centre = size * [1.0, 2.0, 3.0, 4.0]
    H = frequency_response(bank, FREQUENCIES, centre + draws, np.zeros((len(draws), 4, 4))).H
    at_centre = frequency_response(bank, FREQUENCIES, centre, covariance)
    ellipses = at_centre.ellipse(361)
    assert ellipses.shape == (4, 361, 2)
    for i, f in enumerate(FREQUENCIES):
        points = np.column_stack([H[:, i].real, H[:, i].imag])
        spread = np.cov(points.T)
        assert at_centre.covariance[i] == pytest.approx(spread, rel=0.05, abs=0.05 * np.abs(spread).max()), f
        assert naive.inside(points, ellipses[i]).mean() == pytest.approx(0.95, abs=0.006), f


def test_no_uncertainty_no_ellipse(rig: dict[str, Any]) -> None:
    one = frequency_response(build_filter_bank(Loop.from_dict(rig)), 1.0, np.ones(4), np.zeros((4, 4)))
    assert np.ptp(one.ellipse(), axis=-2) == pytest.approx(np.zeros((1, 2)), abs=1e-12)
