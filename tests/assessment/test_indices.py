"""Textbook indices on signals of which the value is known."""

from __future__ import annotations

import numpy as np
import pytest

from servoscope.assessment import indices

N = 1200
T = np.arange(N)
PERIOD = 60.0
SINE = np.sin(2.0 * np.pi * T / PERIOD + 0.3)
TRIANGLE = 2.0 / np.pi * np.arcsin(SINE)


def noise(seed: int) -> np.ndarray:
    return 0.02 * np.random.default_rng(seed).standard_normal(N)


def test_a_sine_is_a_regular_oscillation_of_its_period_and_noise_is_none() -> None:
    found = indices.find_oscillation(SINE + 10.0 * noise(1) + 0.002 * T)
    assert found is not None
    assert found.period == pytest.approx(PERIOD, rel=0.02)
    assert found.regularity > 3.0
    assert found.share > 0.8
    assert indices.find_oscillation(noise(2)) is None
    assert indices.find_oscillation(np.ones(N)) is None


def test_half_cycles_are_told_by_their_shape() -> None:
    slow = (indices.band_pass(x + noise(3), 0.3 / PERIOD, 7.0 / PERIOD) for x in (SINE, TRIANGLE))
    of_sine, of_triangle = (indices.shape_index(x, PERIOD) for x in slow)
    assert of_sine < 0.4
    assert of_triangle > 0.6
    assert indices.shape_index(np.zeros(N), PERIOD) == 0.5


def test_cross_correlation_is_odd_in_quadrature_and_even_in_phase() -> None:
    quadrature = np.sin(2.0 * np.pi * T / PERIOD + 0.3 + np.pi / 2.0)
    assert indices.cross_correlation_index(SINE, quadrature) > 0.8
    assert indices.cross_correlation_index(SINE, -SINE) < 0.1


def test_ellipse_width_is_that_of_the_play() -> None:
    lag = 0.4
    y = np.sin(2.0 * np.pi * T / PERIOD + 0.3 - lag)
    assert indices.ellipse_width(3.0 * SINE, y, PERIOD) == pytest.approx(6.0 * np.sin(lag), rel=0.02)
