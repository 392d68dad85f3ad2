"""The public benchmarks: what they compare is comparable."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


def module(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, BENCHMARKS / "public" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    found = importlib.util.module_from_spec(spec)
    sys.modules[name] = found
    spec.loader.exec_module(found)
    return found


@pytest.fixture(scope="module", autouse=True)
def path() -> Iterator[None]:
    before = list(sys.path)
    sys.path.insert(0, str(BENCHMARKS))
    yield
    sys.path[:] = before


class TestPitch:
    @pytest.mark.parametrize("fault", ["air in oil", "low pressure"])
    def test_the_ray_leads_to_the_faulty_dynamics(self, fault: str) -> None:
        """theta of beta_ref = beta + (2 xi/w) beta' + beta''/w^2, ratio by ratio."""
        turbine = module("pitch_turbine")
        (w, xi), (to_w, to_xi) = turbine.HEALTHY, turbine.DYNAMICS[fault]
        ray = turbine.ray(fault)
        assert ray["inertia"] / w**2 == pytest.approx(1.0 / to_w**2, rel=1e-4)
        assert ray["viscous_friction"] * 2.0 * xi / w == pytest.approx(2.0 * to_xi / to_w, rel=1e-4)

    @pytest.mark.slow
    def test_a_fault_begins_at_its_onset(self) -> None:
        turbine = module("pitch_turbine")
        seconds = turbine.ONSET_S + 60.0
        healthy, faulty = (turbine.measure(fault, seconds, 7)[0] for fault in ("", "low pressure"))
        before = healthy.t <= turbine.ONSET_S
        assert np.array_equal(healthy.y[before], faulty.y[before])
        assert np.abs(healthy.y - faulty.y)[~before].max() > 1.0
        A, _, which = turbine.course("low pressure", 60 * 100 * 6)
        assert which[round(turbine.ONSET_S * 100)] == 0 and which[-1] == turbine.STEPS and len(A) == turbine.STEPS + 1


@pytest.mark.slow
@pytest.mark.parametrize(("name", "peer"), [("kf", "filterpy_kf"), ("kf", "statsmodels_kf"), ("rls", "filterpy_rls")])
def test_one_recursion_by_two_libraries_is_one_row(name: str, peer: str) -> None:
    """Where servoscope's estimator is another library's, the table has the same figures twice."""
    noise_immunity = module("noise_immunity")
    rng = np.random.default_rng(4)
    phi = rng.normal(size=(1000, 3))
    eta = phi @ [1.0, 0.5, -0.2] + rng.normal(size=1000)
    given = noise_immunity.Regression(eta, phi, np.ones(3), 0.01 * np.eye(3), 100.0)
    both = noise_immunity.own(name)(given), getattr(noise_immunity, peer)(given)
    assert np.abs(both[0] - both[1]).max() < 1e-10


def test_a_fading_memory_is_least_squares_with_exponential_weights() -> None:
    noise_immunity = module("noise_immunity")
    rng = np.random.default_rng(3)
    phi = rng.normal(size=(3000, 2))
    eta = phi @ [1.0, -2.0] + 0.1 * rng.normal(size=3000)
    given = noise_immunity.Regression(eta, phi, np.zeros(2), np.eye(2) / 200.0, 200.0)
    weights = (1.0 - 1.0 / 200.0) ** np.arange(2999, -1, -1)
    batch = np.linalg.solve((phi.T * weights) @ phi, (phi.T * weights) @ eta)
    assert noise_immunity.filterpy_rls(given)[-1] == pytest.approx(batch, abs=1e-4)
