"""Features at covariates, and against the recording's own past."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from axis_logs import LOOP, axis

import servoscope as ss
from servoscope.core.errors import RecordingError
from servoscope.detection.feature_evidence import FeatureEvidence
from servoscope.evidence.features import learn_features

WARM_LOOP = ss.Loop.from_dict(LOOP.to_dict() | {"columns": {"covariates": {"oil": "oil"}}})


def warm_axis(seed: int, oil: float, seconds: float = 33.0, level: float = 0.0) -> ss.Recording:
    """An axis that needs more u on its way back the warmer its oil is; `level`: what is added to that."""
    made = axis(seed, seconds=seconds, level=level + 0.02 * (oil - 25.0))
    rng = np.random.default_rng(1000 + seed)
    return replace(made, channels={"oil": oil + 0.05 * rng.standard_normal(made.samples)})


@pytest.fixture(scope="module")
def warm() -> ss.Baseline:
    return ss.learn(WARM_LOOP, [warm_axis(k, oil) for k, oil in enumerate((20, 30, 22, 28, 24, 26, 21, 29))])


class TestCovariates:
    def test_what_the_oil_moves_hides_no_change(self, warm: ss.Baseline) -> None:
        """Without the covariate, the same features call the same change healthy."""
        assert warm.features is not None and warm.features.covariates == ("oil",)
        plain, _ = learn_features(LOOP, [warm_axis(k, oil) for k, oil in enumerate((20, 30, 22, 28, 24, 26, 21, 29))])
        assert plain is not None
        healthy, changed = warm_axis(50, 27.0), warm_axis(51, 22.0, level=0.06)
        for model, expected in ((warm.features, True), (plain, False)):
            assert FeatureEvidence.of(model, healthy).changed is None
            assert (FeatureEvidence.of(model, changed).changed is not None) == expected

    def test_beyond_the_learned_range_intervals_widen_and_further_out_nothing_is_known(self, warm: ss.Baseline) -> None:
        one = warm.features
        assert one is not None
        inside, near = (one.statistics[0].predicted(np.array([oil])) for oil in (25.0, 32.0))
        assert (np.diag(near) > np.diag(inside)).all()
        for oil, known in ((32.0, True), (34.0, False)):
            evidence = FeatureEvidence.of(one, warm_axis(60, oil))
            assert evidence.changed is None and bool(evidence.spans) == known

    def test_blocks_of_any_length_give_the_same_bits(self, warm: ss.Baseline) -> None:
        rec, monitor = warm_axis(70, 23.0, seconds=150.0), ss.Monitor(warm)
        end, trace = monitor.run(monitor.init(), rec.r, rec.u, rec.y, channels=rec.channels)
        state, parts = monitor.init(), []
        for a, b in pairwise([0, 1, 777, 1400, rec.samples]):
            channels = {"oil": rec.channels["oil"][a:b]}
            state, part = monitor.run(state.copy(), rec.r[a:b], rec.u[a:b], rec.y[a:b], channels=channels)
            parts.append(part.features)
        assert trace.features is not None and trace.features.max() > 0.0
        assert np.array_equal(state, end) and np.array_equal(np.concatenate(parts), trace.features)

    def test_each_asset_of_a_fleet_has_its_own_oil(self, warm: ss.Baseline) -> None:
        """To the bits that each has alone, wherever the block is cut; one without covariates among them."""
        recordings = [warm_axis(72, 23.0), warm_axis(73, 28.0), warm_axis(74, 26.0, level=0.1)]
        kinds = [warm, warm.at({"oil": 28.0}), warm]
        fleet, parts = ss.Monitor(kinds), []
        signals = [np.stack([getattr(one, name) for one in recordings]) for name in ("r", "u", "y")]
        oil = np.stack([one.channels["oil"] for one in recordings])
        state = fleet.init()
        for a, b in pairwise([0, 1, 777, recordings[0].samples]):
            state, trace = fleet.run(state, *(x[:, a:b] for x in signals), channels={"oil": oil[:, a:b]})
            parts.append(trace)
        latest = fleet.latest(state)
        for asset, (one, kind) in enumerate(zip(recordings, kinds, strict=True)):
            monitor = ss.Monitor(kind)
            end, alone = monitor.run(monitor.init(), one.r, one.u, one.y, channels=one.channels)
            for name in ("theta", "expected", "statistic", "ready", "features"):
                together = np.concatenate([getattr(part.lane(asset), name) for part in parts])
                assert np.array_equal(together, getattr(alone, name)), name
            assert np.array_equal(state[asset][: end.size], end)
            assert latest.lane(asset).statistic[0] == alone.statistic[-1]
        with pytest.raises(RecordingError, match="oil"):
            fleet.run(fleet.init(), *signals)

    def test_a_monitor_at_one_temperature_asks_for_no_column(self, warm: ss.Baseline) -> None:
        monitor, rec = ss.Monitor(warm.at({"oil": 23.0})), warm_axis(71, 23.0, seconds=150.0)
        _, trace = monitor.run(monitor.init(), rec.r, rec.u, rec.y)
        assert trace.features is not None and 0.0 < trace.features.max() < 1.0


def test_a_change_within_a_recording_is_found_by_its_own_past() -> None:
    """Recordings whose levels differ by more than the change say nothing; the recording's beginning does."""
    learned = [axis(k, level=0.3 * np.sin(2.0 * k)) for k in range(8)]
    model, _ = learn_features(LOOP, learned)
    assert model is not None and model.compares_past
    healthy, changed = axis(80, seconds=33.0, level=0.1), axis(80, seconds=33.0, level=0.25)
    at = healthy.samples // 2
    u = np.where(np.arange(healthy.samples) < at, healthy.u, changed.u)
    assert FeatureEvidence.of(model, healthy).changed is None
    assert FeatureEvidence.of(model, changed).changed is None
    assert FeatureEvidence.of(model, replace(healthy, u=u)).changed is not None
