"""Like machines as a prior: the textbook's combination, what it is worth, and who is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import servoscope as ss
from servoscope.baseline.records import HealthyScatter
from servoscope.core.errors import BaselineError
from servoscope.evidence.population import NormalPrior, Population
from servoscope.simulation import reference, simulate
from servoscope.simulation.tutorial import AXIS, motion

UNKNOWN = {**AXIS, "plant": {"kind": "polynomial", "order": 2, "friction": "coulomb", "offset": True}}


def record(seed: int, machine: int, stiff: float = 1.0, seconds: float = 20.0) -> ss.Recording:
    """Return a recording of one of many motor axes, whose parameters are off by 4 % each."""
    loop = ss.Loop.from_dict(AXIS)
    off = np.exp(np.random.default_rng(machine).normal(0.0, 0.04, 2))
    ratios = {"inertia": off[0], "viscous_friction": off[1] * stiff}
    loop = loop.model_copy(update={"plant": loop.plant.with_ratios(ratios)})
    r = motion(seed)[: round(seconds * loop.sample_rate)]
    return simulate(loop, r, noise_u_std=0.02, noise_y_std=5e-6, seed=seed)[0]


@pytest.fixture(scope="module")
def known() -> dict[str, ss.Baseline]:
    loop = ss.Loop.from_dict(UNKNOWN)
    return {f"axis {i}": ss.learn(loop, [record(10 * i + k, i) for k in range(2)]) for i in range(1, 9)}


def scatter_of(covariance: np.ndarray) -> HealthyScatter:
    return HealthyScatter(between=tuple(map(tuple, covariance.tolist())))


class TestNormalPrior:
    def test_it_is_bayes_rule_for_normal_values(self) -> None:
        """Scalar by hand: precisions add, means weigh by them."""
        prior = NormalPrior(("a",), np.array([2.0]), np.array([[4.0]]))
        mean, C = prior.combine(np.array([5.0]), np.array([[1.0]]))
        assert mean[0] == pytest.approx((5.0 / 1.0 + 2.0 / 4.0) / (1.0 + 0.25))
        assert C[0, 0] == pytest.approx(1.0 / 1.25)

    def test_it_takes_the_place_of_an_earlier_prior(self) -> None:
        """Found with a prior around 0 first: the same as found without it."""
        prior = NormalPrior(("a",), np.array([2.0]), np.array([[4.0]]))
        earlier, own = 0.5, 1.0
        precision = 1.0 / own + 1.0 / earlier**2
        held = prior.combine(np.array([5.0 / own / precision]), np.array([[1.0 / precision]]), earlier)
        free = prior.combine(np.array([5.0]), np.array([[own]]))
        assert held[0] == pytest.approx(free[0])
        assert held[1] == pytest.approx(free[1])

    def test_it_covers_a_further_machine(self) -> None:
        """A 95 % region from eight machines holds nine of ten further ones, though each is known with noise."""
        rng = np.random.default_rng(1)
        inside = 0
        for _ in range(200):
            x = rng.normal(0.0, 1.0, (8, 2)) @ np.array([[1.0, 0.4], [0.0, 0.5]])
            noise = np.broadcast_to(0.04 * np.eye(2), (8, 2, 2))
            prior = NormalPrior.from_machines(("a", "b"), x + rng.normal(0.0, 0.2, x.shape), noise)
            further = rng.normal(0.0, 1.0, 2) @ np.array([[1.0, 0.4], [0.0, 0.5]])
            inside += prior.distance(further, np.zeros((2, 2))) <= 5.99
        assert inside / 200 > 0.85

    def test_machines_that_do_not_differ_are_one(self) -> None:
        C = np.broadcast_to(np.eye(1), (6, 1, 1))
        prior = NormalPrior.from_machines(("a",), np.full((6, 1), 3.0), C)
        assert prior.covariance[0, 0] == pytest.approx(1.0 / 6.0)


class TestPopulation:
    def test_few_of_its_own_kind_are_refused(self) -> None:
        """One in a thousand, however few are known; the limit of chi-squared refuses 55 of these 1000."""
        rng, mixed = np.random.default_rng(5), np.array([[1.0, 0.6, 0.2], [0.0, 0.5, 0.3], [0.0, 0.0, 0.2]])
        nothing, names, refused = np.zeros((3, 3)), ("a", "b", "c"), 0
        for _ in range(1000):
            x = rng.normal(size=(9, 3)) @ mixed
            prior = NormalPrior.from_machines(names, x[:8], np.broadcast_to(1e-9 * np.eye(3), (8, 3, 3)))
            refused += not Population(8, prior, None, nothing, 0.0, False).describe(x[8], nothing)[0]
        assert refused <= 4

    def test_a_new_machine_is_known_better(self, known: dict[str, ss.Baseline]) -> None:
        loop, own = ss.Loop.from_dict(UNKNOWN), [record(500, 50, seconds=12.0)]
        alone, like = ss.learn(loop, own), ss.learn(loop, own, population=known)
        assert any("8 like machines" in str(note) for note in like.notes)
        truth = record_truth(50)
        for name, value in truth.items():
            i = like.names.index(name)
            assert abs(like.theta[i] / value - 1.0) < 0.05
        # the scatter between recordings of the others is believed too: the covariance is honest, not small
        assert like.scatter.between == ()
        assert np.trace(np.linalg.solve(alone.covariance_array(), like.covariance_array())) > 0.0

    def test_a_machine_of_another_kind_is_learned_alone(self, known: dict[str, ss.Baseline]) -> None:
        loop, own = ss.Loop.from_dict(UNKNOWN), [record(501, 51, stiff=3.0)]
        alone, like = ss.learn(loop, own), ss.learn(loop, own, population=known)
        assert any("none of them: viscous_friction" in str(note) for note in like.notes)
        assert like.theta == pytest.approx(alone.theta)

    def test_scatter_of_many_machines_is_worth_more_than_that_of_one(self, known: dict[str, ss.Baseline]) -> None:
        """Alike in their scatter, their degrees of freedom add up; where they differ, little is left of them."""
        rng = np.random.default_rng(3)

        def machines(spread: float) -> dict[str, ss.Baseline]:
            size = np.exp(spread * rng.standard_normal((40, 1)))
            sources = next(iter(known.values())).sources[:1] * 5
            drawn = size * rng.chisquare(4.0, (40, 4)) / 4.0
            one = next(iter(known.values()))
            return {
                str(i): one.model_copy(update={"scatter": scatter_of(np.diag(row)), "sources": sources})
                for i, row in enumerate(drawn)
            }

        alike, unlike = (Population.from_baselines(machines(spread)) for spread in (0.0, 1.5))
        assert np.diag(alike.scatter) == pytest.approx(np.ones(4), rel=0.3)
        assert alike.degrees > 50.0 > 10.0 > unlike.degrees
        one = alike.pooled_scatter(np.zeros((4, 4)), 1)
        assert one == pytest.approx(alike.scatter * alike.degrees / (alike.degrees - 5.0))

    def test_coefficients_that_scatter_together_do_so_in_the_population(self, known: dict[str, ss.Baseline]) -> None:
        """T^2 of further recordings is n on average in every direction; from the diagonal alone it is not."""
        rng = np.random.default_rng(5)
        half = np.array([[1.0, 0.0, 0.0, 0.0], [0.95, 0.3, 0.0, 0.0], [0.9, 0.1, 0.4, 0.0], [0.0, 0.0, 0.0, 1.0]])
        one = next(iter(known.values()))
        blank = {"covariance": tuple(map(tuple, 1e-6 * np.eye(4))), "sources": one.sources[:1] * 4}
        machines = {}
        for k in range(20):
            S = np.cov(rng.standard_normal((4, 4)) @ half.T, rowvar=False)
            machines[str(k)] = one.model_copy(update={**blank, "scatter": scatter_of(S)})
        pooled = Population.from_baselines(machines).pooled_scatter(np.zeros((4, 4)), 1)
        further = rng.standard_normal((4000, 4)) @ half.T
        T2 = np.einsum("ki,ij,kj->k", further, np.linalg.inv(pooled), further)
        diagonal = (further**2 / np.diag(pooled)).sum(axis=1)
        assert T2.mean() == pytest.approx(4.0, rel=0.2)
        assert (T2 > 18.5).mean() < 0.006  # 0.1 % of chi-square with 4 degrees
        assert (diagonal > 18.5).mean() > 0.02

    def test_few_or_other_machines_are_refused(self, known: dict[str, ss.Baseline]) -> None:
        with pytest.raises(BaselineError, match="at least 5 like machines, 2 given"):
            Population.from_baselines(dict(list(known.items())[:2]))
        rig = ss.Loop.load(Path(ss.__file__).parent / "simulation" / "reference-rig.toml")
        other = ss.learn(rig, [simulate(rig, reference("multisine", 30.0, 100.0), seed=1)[0]])
        with pytest.raises(BaselineError, match=r"rig: its coefficients .* are not those of axis 1"):
            Population.from_baselines({**known, "rig": other})


def record_truth(machine: int) -> dict[str, float]:
    """Return the coefficients of a machine of `record`."""
    off = np.exp(np.random.default_rng(machine).normal(0.0, 0.04, 2))
    nominal = AXIS["plant"]["coefficients"]  # type: ignore[index]
    return {"inertia": nominal["inertia"] * off[0], "viscous_friction": nominal["viscous_friction"] * off[1]}
