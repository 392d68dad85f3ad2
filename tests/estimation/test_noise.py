"""The colour of the residual: its spectral factor against the bank's own autocovariance, whitening, Whittle's fit."""

from __future__ import annotations

from typing import Any

import naive
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy import linalg, signal

from servoscope.estimation.filter_bank import FilterBank, nominal_theta
from servoscope.estimation.noise_model import (
    AR_ORDER,
    ArmaNoise,
    WhiteNoise,
    arma_from_white_noise,
    residual_system,
    sample_autocovariance,
    yule_walker,
)
from servoscope.estimation.pipeline import Pipeline
from servoscope.fit.tuning import prefers_white_noise
from servoscope.fit.white_noise import fit_white_noise
from servoscope.models.loop import Loop
from servoscope.models.lti import LinearSystem, autocovariances

PAPER = WhiteNoise(u_std=1e-4, y_std=float(np.sqrt(1e-7)))
AXIS = {"kind": "polynomial", "order": 2, "coefficients": {"viscous_friction": 200.0, "inertia": 90.0}}


def built(rig: dict[str, Any], ratios: dict[str, float], **monitor: Any) -> tuple[FilterBank, naive.Array]:
    """Return the regression of a rig and the coefficients of its plant with other parameters."""
    loop = Loop.from_dict(rig | {"monitor": monitor})
    return Pipeline.of(loop).bank, nominal_theta(loop, loop.plant.with_ratios(ratios))


def loud(bank: FilterBank, theta: naive.Array, noise: WhiteNoise) -> LinearSystem:
    """Return unit white noises -> v."""
    return residual_system(bank, theta).input(np.diag([noise.u_std, noise.y_std]))


def drawn(
    bank: FilterBank, theta: naive.Array, noise: WhiteNoise, samples: int, seed: int, stride: int = 1
) -> naive.Array:
    """Return v as SciPy passes white noises through the bank, at every update, without the start."""
    system, settled = loud(bank, theta, noise), 500
    w = np.random.default_rng(seed).standard_normal((settled + samples * stride, 2))
    numerators = [signal.ss2tf(system.A, system.B, system.C, system.D, input=i) for i in (0, 1)]
    v = sum(signal.lfilter(num[0], den, w[:, i]) for i, (num, den) in enumerate(numerators))
    return np.asarray(v)[settled::stride]


def white_within(e: naive.Array, lags: int = 20) -> None:
    """Check that a signal is white with unit variance, as far as its length tells."""
    N = len(e)
    assert (e**2).mean() == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / N))
    correlation = np.array([e[lag:] @ e[: N - lag] / N for lag in range(1, lags + 1)])
    assert np.abs(correlation).max() < 4.0 / np.sqrt(N)


class TestFactorisation:
    @settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
    @given(
        u_std=st.floats(-3.0, 0.5), y_std=st.floats(-1.0, 1.0), stride=st.integers(1, 4),
        leak=st.floats(-0.5, 0.5), oil=st.floats(-2.0, 1.0), friction=st.floats(-0.5, 1.6),
        cutoff=st.sampled_from([5.0, 10.0, 20.0]), hold=st.sampled_from(["zoh", "foh"]), delay=st.floats(0.0, 0.02),
    )  # fmt: skip
    def test_has_the_autocovariance_of_the_bank(
        self, rig: dict[str, Any], u_std: float, y_std: float, stride: int, leak: float, oil: float, friction: float,
        cutoff: float, hold: str, delay: float,
    ) -> None:  # fmt: skip
        ratios = {"C_ie": 10.0**leak, "beta": 10.0**oil, "b_p": 10.0**friction}
        bank, theta = built(rig | {"hold": hold, "delay": delay}, ratios, cutoff=cutoff)
        # where zeros are all but lost behind others, roots are known less well: 6e-8 was the worst of 1500 draws
        self.agrees(bank, theta, WhiteNoise(10.0**u_std * PAPER.u_std, 10.0**y_std * PAPER.y_std), stride, 1e-7)

    @pytest.mark.parametrize("stride", [1, 2, 5])
    @pytest.mark.parametrize("louder", [0.01, 1.0, 10.0])
    def test_is_exact_on_the_rig(self, rig: dict[str, Any], louder: float, stride: int) -> None:
        bank, theta = built(rig, {})
        self.agrees(bank, theta, WhiteNoise(louder * PAPER.u_std, PAPER.y_std), stride, 1e-9)

    def agrees(self, bank: FilterBank, theta: naive.Array, noise: WhiteNoise, stride: int, tolerance: float) -> None:
        model = arma_from_white_noise(bank, theta, noise, stride)
        of_bank = autocovariances(loud(bank, theta, noise), 60, stride)[:, 0, 0]
        assert np.abs(model.autocovariance(60) - of_bank).max() < tolerance * of_bank[0]
        # invertible, or whitening would run away
        assert np.abs(np.roots(np.concatenate([[1.0], model.b]))).max(initial=0.0) < 1.0
        assert np.abs(np.roots(np.concatenate([[1.0], -model.a]))).max() < 1.0

    def test_heads_are_those_of_the_state_space_form(self, rig: dict[str, Any]) -> None:
        """E v(k)v(k-j) and E v(k)e(k-j), from which the covariance of theta_hat grows."""
        model = arma_from_white_noise(*built(rig, {}), PAPER, 1)
        p, q = len(model.a), len(model.b)
        noise = naive.Spread(1, model.a, model.b, model.variance)
        assert noise.stationary[0, :p] == pytest.approx(model.gamma, rel=1e-8)
        assert noise.stationary[0, p : p + q] == pytest.approx(model.c, rel=1e-9)

    @pytest.mark.parametrize("structure", ["tustin", "tustin-held"])
    def test_a_regression_without_poles_is_a_moving_average(self, rig: dict[str, Any], structure: str) -> None:
        bank, theta = built(rig, {}, structure=structure)
        model = arma_from_white_noise(bank, theta, PAPER, 1)
        of_bank = autocovariances(loud(bank, theta, PAPER), 20)[:, 0, 0]
        assert np.abs(model.autocovariance(20) - of_bank).max() < 1e-9 * of_bank[0]
        assert not np.any(model.a)


class TestWhitening:
    @pytest.mark.parametrize("stride", [1, 4])
    @pytest.mark.parametrize("ratios", [{}, {"beta": 0.1}, {"b_p": 40.0}], ids=["healthy", "beta", "b_p"])
    def test_gives_white_noise_of_unit_variance(
        self, rig: dict[str, Any], ratios: dict[str, float], stride: int
    ) -> None:
        bank, theta = built(rig, ratios)
        v = drawn(bank, theta, PAPER, 20_000, 1, stride)
        white_within(arma_from_white_noise(bank, theta, PAPER, stride).whiten(v)[500:])

    def test_an_autoregression_of_ten_is_not_white_where_the_notch_is(self, rig: dict[str, Any]) -> None:
        """So that the test above can fail: no short autoregression draws the notch at low frequencies."""
        bank, theta = built(rig, {})
        v = drawn(bank, theta, PAPER, 60_000, 1)
        power = {}
        for name, model in (
            ("arma", arma_from_white_noise(bank, theta, PAPER, 1)),
            ("ar", yule_walker(sample_autocovariance([v], 10))),
        ):
            f, S = signal.welch(model.whiten(v)[500:], fs=100.0, nperseg=4096)
            power[name] = float(S[(f > 0.05) & (f < 0.5)].mean() * 50.0)  # 1 for white noise
        assert power["arma"] == pytest.approx(1.0, abs=0.25)
        assert power["ar"] < 0.5

    def test_is_undone_by_shaping(self, rig: dict[str, Any]) -> None:
        model = arma_from_white_noise(*built(rig, {}), PAPER, 1)
        x = np.random.default_rng(3).standard_normal((400, 2))
        assert model.shape(model.whiten(x)) == pytest.approx(x, rel=1e-9, abs=1e-9)


def test_yule_walker_and_sample_autocovariance_are_the_textbook() -> None:
    a = np.array([1.2, -0.5])
    v = signal.lfilter([1.0], [1.0, -1.2, 0.5], np.random.default_rng(0).standard_normal(50_000))
    gamma = sample_autocovariance([v[:20_000], v[20_000:]], 2)
    assert gamma[1] == pytest.approx((v[1:20_000] @ v[:19_999] + v[20_001:] @ v[20_000:-1]) / 50_000, rel=1e-12)
    model = yule_walker(gamma)
    assert model.a == pytest.approx(linalg.solve(linalg.toeplitz(gamma[:2]), gamma[1:]), rel=1e-6)
    assert model.a == pytest.approx(a, abs=0.02) and model.variance == pytest.approx(1.0, abs=0.03)
    assert coloured_is_autoregressive(model)
    # a run shorter than the lags has no products at the others
    assert sample_autocovariance([np.ones(2), np.ones(6)], 4) == pytest.approx(
        np.array([8.0, 6.0, 4.0, 3.0, 2.0]) / 8.0
    )


def coloured_is_autoregressive(model: ArmaNoise) -> bool:
    """Check that the autocovariance goes on as v(k) = a' v_past does."""
    gamma = model.autocovariance(12)
    return bool(np.allclose(gamma[3:], model.a[0] * gamma[2:-1] + model.a[1] * gamma[1:-2], rtol=1e-12))


class TestWhittle:
    @pytest.mark.parametrize(("u", "y", "stride"), [(1.0, 1.0, 1), (10.0, 1.0, 1), (1.0, 0.3, 1), (10.0, 1.0, 4)])
    def test_recovers_both_noises(self, rig: dict[str, Any], u: float, y: float, stride: int) -> None:
        bank, theta = built(rig, {})
        truth = np.array([u * PAPER.u_std, y * PAPER.y_std])
        fits = []
        for seed in range(12):
            v = drawn(bank, theta, WhiteNoise(*truth), 6000 // stride, seed, stride)
            found = fit_white_noise(residual_system(bank, theta), [v[: len(v) // 3], v[len(v) // 3 :]], stride)
            fits.append([found.noise.u_std, found.noise.y_std])
            assert found.loudest.u_std >= found.noise.u_std and found.loudest.y_std >= found.noise.y_std
        relative = np.array(fits) / truth
        scatter = relative.std(axis=0, ddof=1)
        assert np.abs(relative.mean(axis=0) - 1.0).max() < 0.02 + 3.0 * scatter.max() / np.sqrt(12)
        # two variances from N numbers: the loud one is known to about 1/sqrt(2 N), the quiet one from few frequencies
        assert scatter[1] < 0.05 and scatter[0] < 0.45

    def test_white_noises_are_told_from_others(self, rig: dict[str, Any]) -> None:
        """A sensor whose noise is red, and a loud hum, are not two white noises: an autoregression says more."""
        bank, theta = built(rig, {})
        white = drawn(bank, theta, PAPER, 6000, 1)
        hum = np.sqrt(2.0) * white.std() * np.sin(2.0 * np.pi * 12.0 * np.arange(6000) / 100.0)
        red = signal.lfilter([1.0], [1.0, -0.5], white)
        for v, said in ((white, True), (white + hum, False), (red, False)):
            noises = fit_white_noise(residual_system(bank, theta), [v], 1)
            assert prefers_white_noise([v], noises, yule_walker(sample_autocovariance([v], AR_ORDER))) is said
