"""Discrete bricks against continuous systems simulated in small steps, and the algebra that joins them."""

from __future__ import annotations

from typing import Literal

import naive
import numpy as np
import pytest
from scipy import signal

from servoscope.models.lti import (
    LinearSystem,
    autocovariances,
    block_diagonal,
    companion_pairs,
    output_deviations,
    sample_system,
    settling_samples,
    state_variable_filter,
    stretched_filter,
    tapped_delay_line,
    truncate_states,
    unit_states,
)

RATE = 100.0
HOLDS: tuple[Literal["zoh", "foh"], ...] = ("zoh", "foh")


def noise(samples: int, seed: int = 0) -> naive.Array:
    return np.random.default_rng(seed).standard_normal(samples) + 1.0


class TestSampled:
    @pytest.mark.parametrize("hold", HOLDS)
    @pytest.mark.parametrize("delay", [0.0, 0.0037, 0.01, 0.0249])
    def test_is_exact_for_held_and_ramped_inputs_that_arrive_late(
        self, hold: Literal["zoh", "foh"], delay: float
    ) -> None:
        w = noise(120)
        ours = sample_system(state_variable_filter(10.0, 4), RATE, hold, delay).simulate(w[:, None])
        for power in range(4):
            theirs = naive.svf(w, power, 10.0, 4, RATE, hold, delay, steps=100)
            assert np.abs(ours[:, power] - theirs).max() < 1e-9 * np.abs(theirs).max(), power

    @pytest.mark.parametrize("hold", HOLDS)
    def test_starts_at_rest_at_the_first_input(self, hold: Literal["zoh", "foh"]) -> None:
        system = sample_system(state_variable_filter(10.0, 4), RATE, hold, 0.0137)
        out = system.simulate(np.full((50, 1), 3.0))
        assert out == pytest.approx(np.tile([3.0, 0.0, 0.0, 0.0], (50, 1)), abs=1e-4)  # s^3 F is of size 1e5


class TestAlgebra:
    def systems(self) -> tuple[LinearSystem, LinearSystem]:
        first = sample_system(state_variable_filter(5.0, 2), RATE, "zoh").output(np.array([[1.0, 0.02]]))
        return first, sample_system(state_variable_filter(20.0, 3), RATE, "foh").output(np.eye(1, 3))

    def test_series_is_one_after_the_other(self) -> None:
        first, second = self.systems()
        w = noise(80)[:, None]
        w -= w[0]  # from rest: a series connection and its parts then start alike
        assert first.then(second).simulate(w) == pytest.approx(second.simulate(first.simulate(w)), abs=1e-12)

    def test_stack_shares_nothing(self) -> None:
        first, second = self.systems()
        w = np.column_stack([noise(80, 1), noise(80, 2)])
        both = block_diagonal([first, second]).simulate(w)
        assert both == pytest.approx(np.hstack([first.simulate(w[:, :1]), second.simulate(w[:, 1:])]), abs=1e-12)

    def test_inputs_and_outputs_are_mixed_before_and_after(self) -> None:
        both = block_diagonal(self.systems())
        before, after = np.array([[1.0, -2.0, 0.5], [0.0, 3.0, 1.0]]), np.array([[2.0, 0.1]])
        w = np.column_stack([noise(80, seed) for seed in range(3)])
        mixed = both.input(before).output(after).simulate(w)
        assert mixed == pytest.approx(both.simulate(w @ before.T) @ after.T, abs=1e-12)

    def test_steady_state_stands_still(self) -> None:
        first, second = self.systems()
        both = block_diagonal([first, second, tapped_delay_line(np.ones(4))])
        x = both.steady @ np.array([1.0, -2.0, 0.5])
        assert both.A @ x + both.B @ np.array([1.0, -2.0, 0.5]) == pytest.approx(x, rel=1e-10, abs=1e-12)

    def test_taps_are_a_convolution(self) -> None:
        w, weights = noise(40), np.array([[1.0, 3.0, 3.0, 1.0], [0.0, 0.0, 2.0, 0.0]])
        out = tapped_delay_line(weights).simulate(w[:, None])
        padded = np.concatenate([np.full(3, w[0]), w])
        for row, column in zip(weights, out.T, strict=True):
            assert column == pytest.approx(np.convolve(padded, row)[3 : 3 + len(w)], abs=1e-12)

    def test_a_single_tap_is_a_gain_without_state(self) -> None:
        w = noise(5)[:, None]
        assert tapped_delay_line(np.array([2.5])).simulate(w) == pytest.approx(2.5 * w)


class TestAutocovariances:
    @pytest.mark.parametrize("stride", [1, 3])
    def test_are_those_of_the_impulse_responses(self, stride: int) -> None:
        """E[v(k + lag) v(k)'] under white inputs is the sum over the past of the responses' products."""
        first = sample_system(state_variable_filter(5.0, 2), RATE, "zoh")
        system = block_diagonal([first, sample_system(state_variable_filter(20.0, 2), RATE, "foh")])
        mix = np.array([[1.0, 0.02, 0.0, 0.0], [0.3, 0.0, 1.0, 1e-3]])
        system = system.output(mix)
        pulse = np.zeros((2000, 2, 2))
        for i in range(2):
            w = np.zeros((2001, 2))
            w[1, i] = 1.0  # the first sample sets the steady state
            pulse[:, :, i] = system.simulate(w)[1:]
        ours = autocovariances(system, 4, stride)
        for lag in range(5):
            shift = lag * stride
            theirs = np.einsum("kpi,kqi->pq", pulse[shift:], pulse[: 2000 - shift])
            assert ours[lag] == pytest.approx(theirs, rel=1e-8, abs=1e-10), lag

    def test_of_a_gain(self) -> None:
        gain = tapped_delay_line(np.array([2.0]))
        assert autocovariances(gain, 2)[:, 0, 0] == pytest.approx([4.0, 0.0, 0.0])


class TestStateVariableFilter:
    @pytest.mark.parametrize("order", [2, 4, 5])
    def test_frequency_response(self, order: int) -> None:
        A, B, C = state_variable_filter(10.0, order)
        for f in (0.5, 10.0, 30.0):
            s = 2j * np.pi * f
            H = C @ np.linalg.solve(s * np.eye(order) - A, B)
            assert H[:, 0] == pytest.approx(s ** np.arange(order) / (1.0 + s / (20.0 * np.pi)) ** order, rel=1e-12)

    @pytest.mark.parametrize(("cutoff", "order"), [(10.0, 4), (2.0, 3), (20.0, 5)])
    def test_settling_is_the_first_sample_after_which_a_step_is_over(self, cutoff: float, order: int) -> None:
        w = np.concatenate([[0.0], np.ones(400)])
        left = np.abs(naive.svf(w, 0, cutoff, order, RATE, "zoh") - 1.0)[1:]  # left[i]: i samples after the step
        count = settling_samples(cutoff, order, 1.0 / RATE)
        assert left[count] <= 1e-3 < left[count - 1]


class TestTruncation:
    """A chain of six equal lags beside a slow pole; all poles but one are the same."""

    def chain(self) -> LinearSystem:
        lag = LinearSystem(*(np.array([[x]]) for x in (0.6, 0.4, 1.0, 0.0)))
        system = lag
        for _ in range(5):
            system = system.then(lag)
        slow = LinearSystem(*(np.array([[x]]) for x in (0.99, 0.01, 1.0, 0.0)))
        return unit_states(block_diagonal([system, slow]).input(np.ones((2, 1))), 0.9)

    def test_few_states_err_by_no_more_than_was_allowed(self) -> None:
        system, w = self.chain(), signal.lfilter([1.0], [1.0, -0.9], np.random.default_rng(0).standard_normal(20_000))
        size = 0
        for tolerance in (0.3, 0.01):
            rows = np.array([[1.0, 0.0], [1.0, -1.0]])
            rows /= output_deviations(system.output(rows), 0.9)[:, None]
            smaller = truncate_states(system, rows, 0.9, tolerance)
            errors = (smaller.simulate(w[:, None]) - system.simulate(w[:, None])) @ rows.T
            assert np.all(errors.std(axis=0) < 1.1 * tolerance)
            assert smaller.D + smaller.C @ smaller.steady == pytest.approx(system.D + system.C @ system.steady)
            assert size < len(smaller.A) < len(system.A)
            size = len(smaller.A)

    def test_pairs_do_the_same(self) -> None:
        rng = np.random.default_rng(1)
        A = np.diag([0.9, 0.5, -0.3, 0.0, 0.0])
        A[3:, 3:] = [[0.6, 0.5], [-0.5, 0.6]]
        system = LinearSystem(A, rng.standard_normal((5, 1)), rng.standard_normal((2, 5)), rng.standard_normal((2, 1)))
        w = rng.standard_normal((200, 1))
        assert companion_pairs(system).simulate(w) == pytest.approx(system.simulate(w), rel=1e-9, abs=1e-9)

    def test_a_stretched_filter_sees_every_third_input(self) -> None:
        w = np.random.default_rng(2).standard_normal(90)
        w[:30] = 0.0
        numerator, denominator = np.array([1.0, -0.4, 0.2]), np.array([1.0, 0.3, -0.5])
        v = stretched_filter(numerator, denominator, 3).simulate(w[:, None])[:, 0]
        for phase in range(3):
            assert v[phase::3] == pytest.approx(signal.lfilter(numerator, denominator, w[phase::3]), abs=1e-12)
