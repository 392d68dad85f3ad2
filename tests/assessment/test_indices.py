"""Textbook indices on signals of which the value is known."""

from __future__ import annotations

import numpy as np
import pytest

from servoscope.assessment import indices, models

N = 1200
T = np.arange(N)
PERIOD = 60.0
SINE = np.sin(2.0 * np.pi * T / PERIOD + 0.3)
TRIANGLE = 2.0 / np.pi * np.arcsin(SINE)
SQUARE = np.sign(SINE)


def noise(seed: int) -> np.ndarray:
    return 0.02 * np.random.default_rng(seed).standard_normal(N)


def test_a_sine_is_a_regular_oscillation_of_its_period_and_noise_is_none() -> None:
    found = indices.find_oscillation(SINE + 10.0 * noise(1) + 0.002 * T)
    assert found is not None
    assert found.period == pytest.approx(PERIOD, rel=0.02)
    assert found.regularity > 3.0
    assert found.share > 0.8
    alone = indices.find_oscillation(noise(2))
    assert alone is not None
    assert alone.regularity < 1.0
    assert indices.find_oscillation(np.ones(N)) is None


def test_half_cycles_are_told_by_their_shape() -> None:
    of_sine, of_triangle = (indices.shape_index(x + noise(3), PERIOD)[0] for x in (SINE, TRIANGLE))
    assert of_sine < 0.4
    assert of_triangle > 0.6
    assert indices.shape_index(SQUARE + noise(4), PERIOD)[1] > 0.8
    assert indices.shape_index(np.zeros(N), PERIOD) == (0.5, 0.5)


def test_cross_correlation_is_odd_in_quadrature_and_even_in_phase() -> None:
    quadrature = np.sin(2.0 * np.pi * T / PERIOD + 0.3 + np.pi / 2.0)
    assert indices.cross_correlation_index(SINE, quadrature) > 0.8
    assert indices.cross_correlation_index(SINE, -SINE) < 0.1


def test_ellipse_width_is_that_of_the_play() -> None:
    lag = 0.4
    y = np.sin(2.0 * np.pi * T / PERIOD + 0.3 - lag)
    assert indices.ellipse_width(3.0 * SINE, y, PERIOD) == pytest.approx(6.0 * np.sin(lag), rel=0.02)


def test_harris_index_is_one_of_white_noise_and_falls_with_memory() -> None:
    white = np.random.default_rng(5).standard_normal(4000)
    assert indices.harris_index(white, 1) > 0.95
    slow = np.convolve(white, 0.9 ** np.arange(60))[:4000]
    assert indices.harris_index(slow, 1) == pytest.approx(1.0 - 0.9**2, abs=0.04)  # 1 - a^2 of AR(1)
    assert np.isnan(indices.harris_index(np.zeros(200), 1))


def test_stick_slip_is_the_obvious_loop() -> None:
    rng = np.random.default_rng(6)
    u = np.cumsum(rng.standard_normal(300))
    static, kinetic = 1.5, 0.4
    first = u[0] + 1.0
    x, expected = first, []
    for value in u:
        if abs(value - x) > static:
            x = value - np.sign(value - x) * kinetic
        expected.append(x)
    np.testing.assert_allclose(
        models.stick_slip(u, np.array([static]), np.array([kinetic]), np.array([first]))[0], expected
    )


@pytest.mark.parametrize(("jump", "kind"), [(1.5, "stick"), (0.0, "dead_band")])
def test_the_model_that_made_the_record_is_the_likeliest(jump: float, kind: str) -> None:
    rng = np.random.default_rng(7)
    u = 5.0 * SINE + 0.3 * rng.standard_normal(N)
    size = 1.5
    x = models.stick_slip(u, np.array([0.5 * (size + jump)]), np.array([0.5 * (size - jump)]), u[:1])[0]
    y = np.zeros(N)
    for k in range(2, N):
        y[k] = 0.7 * y[k - 1] + 0.3 * x[k - 2]
    (evidence,) = models.compare_models(u, y + noise(8), PERIOD)
    best = getattr(evidence, kind)
    assert evidence.gain(best, 2) > 100.0
    assert best.size == pytest.approx(size, rel=0.25)
    assert (evidence.between(evidence.dead_band, evidence.stick) > 0.0) == (kind == "stick")


def test_gain_margin_is_that_of_the_loop_that_was_simulated() -> None:
    """y(k+1) = 0.8 y(k) + 0.2 u(k) with u(k) = u(k-1) + c (e(k) - 0.8 e(k-1)): L = 0.2 c / (z - 1), margin 10 / c."""
    rng = np.random.default_rng(9)
    y, u, e, c = np.zeros(4000), np.zeros(4000), np.zeros(4000), 2.0
    d = 0.3 * rng.standard_normal(4000)
    for k in range(1, 4000):
        y[k] = 0.8 * y[k - 1] + 0.2 * u[k - 1] + 0.2 * d[k]
        e[k] = -y[k]
        u[k] = u[k - 1] + c * (e[k] - 0.8 * e[k - 1]) + 0.5 * rng.standard_normal()
    (fit,) = models.fit_models(u[None], y, np.array([0]))
    assert models.estimate_margins(fit, e, u).gain == pytest.approx(10.0 / c, rel=0.15)
