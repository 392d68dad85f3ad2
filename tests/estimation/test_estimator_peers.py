"""Estimators against independent implementations and each other, at rest, inside the recursion and on recordings."""

from __future__ import annotations

import itertools
from functools import cache
from pathlib import Path
from typing import Any

import naive
import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from statsmodels.regression.recursive_ls import RecursiveLS
from statsmodels.regression.rolling import RollingOLS
from statsmodels.tsa.statespace.kalman_filter import KalmanFilter as StateSpace
from test_estimators import ALL, MEMORY, R, Run, n, samples, share_left, spd

from servoscope.baseline.baseline import Baseline
from servoscope.diagnosis.diagnose import diagnose_with_trace
from servoscope.estimation import estimators
from servoscope.estimation.pipeline import Pipeline, Tuning
from servoscope.estimation.recursion import Recursion, RecursionConstants
from servoscope.fit.tuning import fit_tuning
from servoscope.learning.learn import learn_baseline
from servoscope.models.loop import Loop
from servoscope.signals.readers import read
from servoscope.simulation import reference, simulate

HONEST = [name for name in ALL if not {"covariance", "mean"} & set(estimators.exceptions(name))]

REST = 10_000  # samples at rest that one call takes: a call for each would take minutes


def filterpy_of(run: Run) -> KalmanFilter:
    """Return filterpy's Kalman filter of the random walk (5), (6), at the state of a run."""
    peer = KalmanFilter(dim_x=n, dim_z=1)
    peer.x, peer.P, peer.F = run.theta[:, None].copy(), run.P.copy(), np.eye(n)
    peer.R, peer.Q = np.array([[R]]), np.zeros((n, n))
    return peer


def assert_same(run: Run, theta: naive.Array, P: naive.Array, tolerance: float = 1e-9) -> None:
    assert np.abs(run.theta - theta).max() < tolerance * max(1.0, np.abs(theta).max())
    assert np.abs(run.P - P).max() < tolerance * np.abs(P).max()


class TestPeers:
    def test_kf_is_filterpys(self) -> None:
        run = Run("kf")
        peer = filterpy_of(run)
        peer.Q = run.P_d / MEMORY
        for eta, phi, _ in zip(*samples(2000), strict=True):
            run.step(eta, phi)
            peer.update(eta, H=phi[None, :])
            peer.predict()
            assert_same(run, peer.x[:, 0], peer.P)

    def test_kf_is_statsmodels(self) -> None:
        run, (eta, phi, _) = Run("kf"), samples(500)
        peer = StateSpace(k_endog=1, k_states=n, k_posdef=n)
        peer.bind(eta[:, None])
        peer["design"] = np.ascontiguousarray(phi.T[None, :, :])
        peer["transition"], peer["selection"], peer["state_cov"] = np.eye(n), np.eye(n), run.P_d / MEMORY
        peer["obs_cov"] = np.array([[R]])
        peer.initialize_known(run.theta.copy(), run.P.copy())
        result = peer.filter()
        for k in range(len(eta)):
            run.step(eta[k], phi[k])
            assert_same(run, result.predicted_state[:, k + 1], result.predicted_state_cov[:, :, k + 1])

    def test_akf_is_filterpys_with_the_adaptive_Q(self) -> None:
        """Eq. (11) is the standard filter with Q(k) = P_d phi phi' P_d / (R + phi' P_d phi)."""
        run = Run("akf")
        peer = filterpy_of(run)
        for eta, phi, _ in zip(*samples(2000), strict=True):
            run.step(eta, phi)
            peer.update(eta, H=phi[None, :])
            g = run.P_d @ phi
            peer.predict(Q=np.outer(g, g) / (R + phi @ g))
            assert_same(run, peer.x[:, 0], peer.P)

    def test_rls_is_filterpys_with_a_fading_memory(self) -> None:
        run, l = Run("rls"), 1.0 - 1.0 / MEMORY
        peer = filterpy_of(run)
        peer.alpha, peer.R = l**-0.5, np.array([[l * R]])
        for eta, phi, _ in zip(*samples(2000), strict=True):
            run.step(eta, phi)
            peer.update(eta, H=phi[None, :])
            peer.predict()
            assert_same(run, peer.x[:, 0], peer.P)

    @pytest.mark.parametrize("name", ["rls", "kf", "rls-reset"])
    def test_without_forgetting_they_are_recursive_least_squares(self, name: str) -> None:
        eta, phi, _ = samples(400)
        run, peer = Run(name, P=1e9 * np.eye(n), memory=np.inf), RecursiveLS(eta, phi).fit()
        kalman = filterpy_of(run)
        for k in range(len(eta)):
            run.step(eta[k], phi[k])
            kalman.update(eta[k], H=phi[k][None, :])
            kalman.predict()
            if k > 20:
                assert run.theta == pytest.approx(peer.recursive_coefficients.filtered[:, k], abs=1e-6)
                assert_same(run, kalman.x[:, 0], kalman.P, 1e-6)

    def test_sliding_window_is_rolling_least_squares(self) -> None:
        (eta, phi, _), window = samples(1000), 60
        peer = RollingOLS(eta, phi, window=window).fit(method="lstsq").params
        run = Run("sliding-window", memory=window)
        for k in range(len(eta)):
            run.step(eta[k], phi[k])
            if k >= window:
                assert run.theta == pytest.approx(peer[k], rel=1e-9, abs=1e-9)

    def test_akf_at_P_d_is_nlms_in_its_metric(self) -> None:
        run, L = Run("akf", P=spd(2)), np.linalg.cholesky(spd(2))
        theta = np.linalg.solve(L, run.theta)
        for eta, phi, _ in zip(*samples(500), strict=True):
            run.step(eta, phi)
            x = L.T @ phi
            theta += x * (eta - x @ theta) / (R + x @ x)
        assert run.theta == pytest.approx(L @ theta, rel=1e-9)


class TestSlidingWindow:
    def test_is_batch_least_squares_after_a_million_samples(self) -> None:
        run, (eta, phi, z) = Run("sliding-window"), samples(4099)
        run.steps(eta, phi, z, 1_000_000)
        last = np.arange(1_000_000 - round(MEMORY), 1_000_000) % 4099
        theta = np.linalg.lstsq(phi[last], eta[last], rcond=None)[0]
        assert np.abs(run.theta - theta).max() < 1e-14 * 10.0

    def test_a_burst_leaves_no_rounding_behind(self) -> None:
        """Sums that are added to and subtracted from would keep 1e-16 of the burst's squares: 1 beside 100."""
        run, (eta, phi, z) = Run("sliding-window", memory=100.0), samples(1000)
        phi[300:310] *= 1e8
        run.steps(eta[:450], phi[:450], z[:450])
        theta = np.linalg.lstsq(phi[350:450], eta[350:450], rcond=None)[0]
        assert run.theta == pytest.approx(theta, rel=1e-12, abs=1e-13)

    def test_holds_while_its_window_does_not_determine_theta(self) -> None:
        run, (eta, phi, z) = Run("sliding-window", memory=50.0), samples(200)
        run.steps(eta, phi, z)
        stuck = np.tile(phi[:1], (60, 1))
        assert run.steps(eta[:60], stuck, stuck) >= 10
        kept = run.theta.copy(), run.P.copy()
        assert run.step(3.0, phi[0]) == 1
        assert np.array_equal(run.theta, kept[0]) and np.array_equal(run.P, kept[1])
        assert np.array_equal(run.K, np.zeros(n))
        run.steps(eta, phi, z)
        theta = np.linalg.lstsq(phi[-50:], eta[-50:], rcond=None)[0]
        assert run.theta == pytest.approx(theta, rel=1e-12)


class TestWindup:
    def test_at_rest(self) -> None:
        """AKF and DFRLS stand still, KF grows linearly, RLS e-fold every memory until it refuses to go on."""
        rest = np.full(REST, 3.0), np.zeros((REST, n)), np.zeros((REST, n))
        runs = {name: Run(name) for name in ("akf", "dfrls", "rls-reset", "kf", "rls")}
        P, P_d, theta = runs["akf"].P.copy(), runs["akf"].P_d, runs["akf"].theta.copy()
        for run in runs.values():
            run.steps(*rest, 100_000)
        for name in ("akf", "dfrls", "rls-reset"):
            assert np.array_equal(runs[name].P, P)
        assert pytest.approx(P + 200.0 * P_d, rel=1e-8) == runs["kf"].P
        factor = runs["rls"].P / P
        assert np.log(factor) == pytest.approx(-100_000 * np.log(1.0 - 1.0 / MEMORY), rel=1e-9)  # e^200.2
        for name, refused in (("kf", 0), ("rls", 646_000)):
            skipped = runs[name].steps(*rest, 900_000)
            assert skipped == pytest.approx(refused, rel=2e-3)
        assert pytest.approx(P + 2000.0 * P_d, rel=1e-7) == runs["kf"].P
        assert 1e307 < np.abs(runs["rls"].P).max() < np.inf
        assert all(np.array_equal(run.theta, theta) for run in runs.values())

    def test_what_the_next_sample_does_after_a_rest(self) -> None:
        """phi' K, how far theta_hat runs after one noisy sample, after 20 memories of rest."""
        phi, eager = np.array([1.0, 0.5, -1.0, 0.2]), {}
        P_d = R / MEMORY * np.eye(n)
        for name in ("akf", "dfrls", "rls-reset", "kf", "rls"):
            run = Run(name, P_d, P_d)
            run.steps(np.full(REST, 3.0), np.zeros((REST, n)), np.zeros((REST, n)))
            run.step(1.0, phi)
            eager[name] = float(phi @ run.K)
        at_P_d = float(phi @ phi / (MEMORY + phi @ phi))
        for name in ("akf", "dfrls", "rls-reset"):
            assert eager[name] == pytest.approx(at_P_d, rel=1e-12)  # 0.5 %
        assert eager["kf"] == pytest.approx(21.0 * at_P_d, rel=0.1)  # 9 %
        assert eager["rls"] > 0.999999

    def test_rls_stays_finite_when_motion_comes_back_after_it_has_overflowed(self) -> None:
        run = Run("rls")
        run.steps(np.full(REST, 3.0), np.zeros((REST, n)), np.zeros((REST, n)), 1_000_000)
        run.steps(*samples(1000))
        assert np.all(np.isfinite(run.theta)) and np.all(np.isfinite(run.P))

    def test_a_whisper_winds_dfrls_up_but_not_the_akf(self) -> None:
        phi, P_d = np.random.default_rng(1).standard_normal((4099, n)) * 1e-6, R / MEMORY * np.eye(n)
        grown = {}
        for name in ("akf", "dfrls"):
            run = Run(name, P_d, P_d)
            run.steps(np.zeros(4099), phi, phi, 50_000)
            grown[name] = np.trace(run.P) / np.trace(P_d)
        assert grown["akf"] == pytest.approx(1.0, abs=1e-9)
        assert grown["dfrls"] > 1e9


def test_kf_with_Q_of_P_d_over_memory_has_the_memory_of_the_akf() -> None:
    for updates in (100, 250, 500, 1000):
        kf, akf = (share_left(name, np.eye(n), updates) for name in ("kf", "akf"))
        assert kf == pytest.approx(akf, abs=0.01)


Signals = tuple[naive.Array, ...]


@cache
def chain(name: str) -> tuple[Pipeline, Tuning, RecursionConstants, Signals]:
    """Return the recursion of the rig with an estimator, tuned, and a recording with missing values and a gap."""
    path = Path(__file__).parents[2] / "src/servoscope/simulation/reference-rig.toml"
    settings = Loop.load(path).to_dict()
    settings["monitor"] |= {"estimator": name, "memory": 1.0, "evaluation_rate": 100.0}
    loop = Loop.from_dict(settings)
    recording, _ = simulate(loop, reference("multisine", 12.0, 100.0), seed=1)
    pipeline, restart = Pipeline.of(loop), recording.restart.copy()
    g = pipeline.regression(recording.r, recording.u, recording.y, restart)
    tuning = fit_tuning(pipeline, [g]).tuning
    r, u, y = recording.r.copy(), 0.9 * recording.u, recording.y.copy()
    u[300], y[301], r[500:510], restart[700] = np.nan, np.nan, np.nan, True
    return (
        pipeline,
        tuning,
        pipeline.constants(tuning, steady=False),
        tuple(signal[None, :] for signal in (r, u, y, restart)),
    )


@pytest.mark.parametrize("name", ALL)
class TestInTheRecursion:
    def test_is_its_updates_one_after_the_other(self, name: str) -> None:
        pipeline, tuning, c, signals = chain(name)
        recursion = Recursion([c])
        _, out = recursion.run(recursion.start(), *signals)
        assert out.shape[1] == 1200
        g = pipeline.regression(*(signal[0] for signal in signals))
        run = Run(name, c.P_d, c.P_d, c.memory)
        run.theta[:], run.R = c.theta, c.R
        for k in np.flatnonzero(g.ok):
            run.step(g.eta[k], g.phi[k] / tuning.scale, g.z[k] / tuning.scale)
            assert out[0, k, 5 : 5 + n] + c.theta == pytest.approx(run.theta, rel=1e-7, abs=1e-9)
        assert 900 < out[0, -1, 0] <= 1200
        assert recursion.state_type["extra"].shape[0] == estimators.extra_state_size(name, n, c.memory)

    def test_a_missing_value_keeps_the_state(self, name: str) -> None:
        _, _, c, signals = chain(name)
        recursion = Recursion([c])
        kept, _ = recursion.run(recursion.start(), *(signal[:, :290] for signal in signals))
        nothing = np.full((1, 40), np.nan)
        state, _ = recursion.run(kept, nothing, nothing, nothing, np.zeros((1, 40), dtype=np.bool_))
        for part in ("theta", "P", "S", "Psi", "extra"):
            assert np.array_equal(recursion.named(state)[part], recursion.named(kept)[part]), part

    def test_split_saved_and_resumed_anywhere(self, name: str) -> None:
        _, _, c, signals = chain(name)
        recursion = Recursion([c])
        whole, out = recursion.run(recursion.start(), *signals)
        state, parts = recursion.start(), []
        edges = [0, 1, 2, 137, 301, 301, 502, 640, 1199, 1200]
        for begin, end in itertools.pairwise(edges):
            state = np.frombuffer(state.tobytes(), dtype=np.float64).reshape(state.shape)
            state, part = recursion.run(state, *(signal[:, begin:end] for signal in signals))
            parts.append(part)
        assert np.array_equal(state, whole)
        assert np.array_equal(np.concatenate(parts, axis=1), out)

    def test_a_fleet_is_its_assets(self, name: str) -> None:
        _, _, c, signals = chain(name)
        alone, fleet = Recursion([c]), Recursion([c] * 3)
        state, out = alone.run(alone.start(), *signals)
        states, outs = fleet.run(fleet.start(), *(np.repeat(signal, 3, axis=0) for signal in signals))
        assert np.array_equal(states, np.repeat(state, 3, axis=0))
        assert np.array_equal(outs, np.repeat(out, 3, axis=0))


@cache
def baseline(folder: Path, name: str, file: str) -> Baseline:
    path = Path(__file__).parents[2] / "src/servoscope/simulation/reference-rig.toml"
    settings: dict[str, Any] = Loop.load(path).to_dict()
    settings["monitor"]["estimator"] = name
    loop = Loop.from_dict(settings)
    return learn_baseline(loop, [read(folder / file, loop)])


@pytest.mark.parametrize("name", ALL)
@pytest.mark.slow
def test_verdicts_on_recordings_of_the_rig(name: str, eha_cases: Path) -> None:
    """Under steady excitation every estimator's statistic is good; only an honest one's is after rests, too."""
    learned = baseline(eha_cases, name, "multisine_healthy_2.csv")
    diagnosis, trace = diagnose_with_trace(learned, read(eha_cases / "multisine_healthy_3.csv", learned.loop))
    assert diagnosis.verdict == "healthy"
    assert 1.0 < trace.statistic[trace.ready].mean() < 8.0  # four coefficients
    for file, fault, ratio in (("p_sx0.8_10", "pump", 0.8), ("C_iex1.2_11", "leakage", 1.2)):
        diagnosis, trace = diagnose_with_trace(learned, read(eha_cases / f"multisine_{file}.csv", learned.loop))
        assert diagnosis.verdict == "fault" and diagnosis.detected_at_s == pytest.approx(31.0, abs=1.0)
        assert trace.statistic[trace.t < 30.0].max() < trace.threshold
        if diagnosis.faults or name != "nlms":
            assert (diagnosis.faults[0].name, diagnosis.faults[0].ratio) == (fault, pytest.approx(ratio, rel=0.03))


@pytest.mark.parametrize("name", HONEST)
def test_another_reference_with_rests_is_healthy_for_the_honest(name: str, eha_cases: Path) -> None:
    learned = baseline(eha_cases, name, "profile_healthy_0.csv")
    for file in ("profile_healthy_1.csv", "trapezoid_healthy_4.csv"):
        diagnosis, _ = diagnose_with_trace(learned, read(eha_cases / file, learned.loop))
        assert diagnosis.verdict == "healthy", file
