"""What `learn` refuses, or takes, in one line: never a traceback."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import servoscope as ss
from servoscope.core.errors import LoopError, ServoscopeError
from servoscope.learning.plausibility import negative_coefficients
from servoscope.learning.scatter import nearest_covariance
from servoscope.models.loop import MonitorSettings
from servoscope.signals import Recording, clean

PLANT = {"kind": "polynomial", "order": 2, "friction": "coulomb"}
RATE = 50.0


def loop(rate: float = RATE, **monitor: Any) -> ss.Loop:
    return ss.Loop.from_dict({"sample_rate": rate, "plant": PLANT, "monitor": monitor})


def lively(seed: int, rate: float = RATE, samples: int = 4000, inertia: float = 0.02) -> Recording:
    """A random motion of an axis, as lively per sample at every rate."""
    rng, k = np.random.default_rng(seed), np.arange(samples)
    f, phase = rng.uniform(0.002, 0.05, 20), rng.uniform(0.0, 6.28, 20)
    y = (np.sin(2.0 * np.pi * f * k[:, None] + phase) / f).sum(axis=1) / 100.0
    v = np.gradient(y)
    u = 5.0 * inertia * np.gradient(v) + 2.0 * v + 0.5 * np.sign(v) + 0.01 * rng.normal(size=samples)
    return clean(k / rate, y, u, y, name=f"run {seed}", sample_rate=rate)


def winch(seed: int) -> Recording:
    """A rope that is wound up at one speed: inertia, friction and offset cannot be told apart."""
    rng, t = np.random.default_rng(seed), np.arange(3000) / RATE
    y = 0.5 * t + 1e-3 * np.sin(0.5 * t)
    u = 3.0 + 2.0 * np.gradient(y, 1.0 / RATE) + 1e-3 * rng.normal(size=len(t))
    return clean(t, y, u, y, name=f"winch {seed}", sample_rate=RATE)


@pytest.mark.parametrize("plant", [PLANT | {"offset": True}, {"kind": "axis"}])
def test_motion_that_does_not_tell_coefficients_apart_is_no_traceback(plant: dict[str, Any]) -> None:
    told = ss.Loop.from_dict({"sample_rate": RATE, "plant": plant})
    for count in (2, 4):
        try:
            learned = ss.learn(told, [winch(seed) for seed in range(count)], force=True)
        except ServoscopeError as error:
            assert "\n" not in str(error)
        else:
            assert np.linalg.eigvalsh(learned.covariance_array()).min() > 0.0


def test_the_nearest_covariance_keeps_what_is_one() -> None:
    C = np.array([[4.0, 1.0], [1.0, 9.0]])
    assert nearest_covariance(C) is C
    bad = nearest_covariance(np.array([[4.0, 6.0 + 1e-6], [6.0 + 1e-6, 9.0]]))
    assert np.linalg.cholesky(bad).shape == (2, 2)
    assert np.diag(bad) == pytest.approx([4.0, 9.0], rel=1e-6)


def test_an_input_that_is_zero_throughout_is_refused() -> None:
    still = lively(1)
    with pytest.raises(ServoscopeError, match="u is constant"):
        ss.learn(loop(), [clean(still.t, still.r, 0.0 * still.u, still.y, name="still", sample_rate=RATE)])


def test_an_axis_of_inertia_alone_is_learned() -> None:
    """No term is left: u is inertia times the acceleration."""
    moved = lively(1)
    pushed = replace(moved, u=1e3 * np.gradient(np.gradient(moved.y, 1.0 / RATE), 1.0 / RATE))
    bare = ss.Loop.from_dict({"sample_rate": RATE, "plant": {"kind": "axis", "terms": []}})
    assert ss.learn(bare, pushed).theta == pytest.approx([1e3], rel=0.05)


@pytest.mark.parametrize("factor", [1e100, 1e150])
def test_numbers_beyond_all_units_are_refused_or_learned(factor: float) -> None:
    moved = lively(1)
    with suppress(ServoscopeError):
        ss.learn(loop(), replace(moved, u=1e9 + moved.u, y=factor * moved.y))  # its regressors have no eigenvalues


def test_one_recording_needs_no_list() -> None:
    moved = lively(1)
    assert ss.learn(loop(), moved).sources[0].name == "run 1"
    columns = {"t": moved.t, "r": moved.r, "u": moved.u, "y": moved.y}
    for given in (columns, [columns], {"cold": [columns]}, {name: [*x.tolist()] for name, x in columns.items()}):
        assert ss.learn(loop(), given).sources[0].name == "arrays"


class TestSlowLoop:
    def test_the_memory_may_be_given_in_samples(self) -> None:
        slow = loop(0.1, memory_samples=200)
        assert slow.monitor.memory == 2000.0
        assert ss.Loop.from_dict(slow.to_dict()) == slow
        settings = MonitorSettings(memory_samples=200)
        validated = ss.Loop.model_validate({"sample_rate": 0.1, "plant": slow.plant, "monitor": settings})
        assert validated.monitor == slow.monitor

    def test_without_a_memory_it_is_long_enough(self) -> None:
        assert loop(0.1).monitor.memory == 500.0
        assert loop(10.0).monitor.memory == 5.0
        assert "memory_samples" not in loop().to_dict()["monitor"]

    def test_both_are_refused(self) -> None:
        with pytest.raises(LoopError, match="memory_samples: stands for memory"):
            loop(memory=5.0, memory_samples=200)

    def test_it_is_learned_and_diagnosed(self) -> None:
        learned = ss.learn(loop(0.1), [lively(seed, 0.1) for seed in (1, 2)])
        assert ss.diagnose(learned, lively(3, 0.1)).verdict == "healthy"


def test_negative_inertia_is_refused_however_much_it_scatters() -> None:
    learned = ss.learn(loop(), lively(1, inertia=4.0))
    assert not negative_coefficients(learned)
    i = learned.names.index("inertia")
    theta, covariance = np.array(learned.theta), learned.covariance_array()
    theta[i] *= -1.0
    covariance[i, i] = 4.0 * theta[i] ** 2  # two recordings that differ by more than that
    odd = learned.model_copy(update={"theta": tuple(theta), "covariance": tuple(map(tuple, covariance.tolist()))})
    assert [name for name, _, _ in negative_coefficients(odd)] == ["inertia"]


def test_a_baseline_that_detects_nothing_says_so_and_why() -> None:
    """Machines of which each has other friction and inertia, learned as one."""
    runs = [lively(seed, inertia=inertia) for seed, inertia in enumerate((0.5, 1.5, 1.0, 0.2))]
    gains = (1.0, 1.8, 0.6, 1.4)
    scaled = [
        clean(run.t, run.r, gain * run.u, run.y, name=run.name, sample_rate=RATE)
        for gain, run in zip(gains, runs, strict=True)
    ]
    notes = [str(note) for note in ss.learn(loop(), scaled, force=True).notes]
    assert any("nothing can be detected with this baseline, because the healthy recordings differ" in n for n in notes)
