"""Common causes: odds that are right as often as they say, on fleets drawn from the model and from others."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from servoscope.fleet.common_cause import SIZES, Evidence, Prior, causes, fault_probability
from servoscope.fleet.summary import summarise_fleet
from servoscope.scoring import reliability

NAMES = ("p_s", "C_ie", "b_p", "beta")


def information(rng: np.random.Generator, sharp: float) -> np.ndarray[Any, Any]:
    A = rng.normal(size=(4, 4))
    return sharp * (A @ A.T + 0.5 * np.eye(4))


def evidence(rng: np.random.Generator, sizes: np.ndarray[Any, Any], J: np.ndarray[Any, Any]) -> Evidence:
    """Return what an asset with these sizes would bring."""
    score = J @ sizes + np.linalg.cholesky(J) @ rng.normal(size=4)
    return Evidence(NAMES, tuple(score), tuple(map(tuple, J)))


def group(
    rng: np.random.Generator, members: int, prior: Prior, shared: tuple[int, float] = (0, 0.0), sharp: float = 60.0
) -> dict[str, Evidence]:
    found = {}
    for i in range(members):
        sizes = np.zeros(4)
        sizes[shared[0]] += shared[1] * (1.0 + prior.scatter * rng.normal())
        if rng.random() < prior.fault:
            sizes[rng.integers(4)] += prior.size * rng.normal()
        found[f"a{i}"] = evidence(rng, sizes, information(rng, sharp))
    return found


def one_supply(assets: dict[str, Evidence]) -> dict[str, dict[str, str]]:
    return {key: {"supply": "S1"} for key in assets}


def test_the_probability_of_a_common_cause_is_right_as_often_as_it_says() -> None:
    rng, prior = np.random.default_rng(1), Prior(common=0.5, fault=0.05)
    said, truth = [], []
    for _ in range(120):
        common_cause = bool(rng.random() < 0.5)
        size = prior.size if common_cause else prior.drift
        assets = group(rng, 5, prior, (int(rng.integers(4)), float(size * rng.normal())))
        said.append(causes(assets, one_supply(assets), prior)[0].probability)
        truth.append(common_cause)
    told = reliability(np.array(said), np.array(truth), bins=5)
    for claimed, observed, count in zip(told.claimed, told.observed, told.count, strict=True):
        if count:
            assert abs(claimed - observed) < 3.0 * np.sqrt(claimed * (1.0 - claimed) / count) + 0.02
    sure = np.array(said) > 0.95
    assert sure.sum() > 30 and np.array(truth)[sure].all()


def test_forty_pump_faults_of_one_supply_are_one_fault_with_its_size() -> None:
    rng, prior = np.random.default_rng(2), Prior()
    assets = group(rng, 40, Prior(fault=0.0), (0, np.log(0.85)), sharp=3000.0)
    J = information(rng, 3000.0)
    assets["a7"] = evidence(rng, np.array([np.log(0.85), np.log(1.3), 0.0, 0.0]), J)  # with a leak of its own
    (cause,) = causes(assets, one_supply(assets), prior)
    assert cause.probability > 0.999 and cause.parameter == "p_s" and cause.parameter_probability > 0.999
    assert cause.interval[0] < 0.85 < cause.interval[1] and cause.interval[1] - cause.interval[0] < 0.03
    own = dict(zip(cause.members, cause.own, strict=True))
    assert own.pop("a7") > 0.999 and max(own.values()) < 0.2
    assert fault_probability(assets["a3"], prior) > 0.999  # by itself, each of them looks ill


def test_faults_of_their_own_are_no_common_cause() -> None:
    rng, prior = np.random.default_rng(3), Prior()
    highest = 0.0
    for _ in range(40):  # a third of the members ill, each in its own way: worse than the prior expects
        assets = group(rng, 9, Prior(fault=0.33), sharp=1000.0)
        highest = max(highest, causes(assets, one_supply(assets), prior)[0].probability)
    assert highest < 0.2


def test_what_baselines_learned_together_have_wrong_together_is_no_cause() -> None:
    rng = np.random.default_rng(7)
    for shift in (0.003, 0.01, 0.02):
        assets = group(rng, 30, Prior(fault=0.0), (2, shift), sharp=1e5)
        assert causes(assets, one_supply(assets))[0].probability < 0.1


def test_the_smaller_group_that_explains_goes_before_the_larger_one_that_contains_it() -> None:
    rng = np.random.default_rng(4)
    ill, well = (group(rng, 8, Prior(fault=0.0), shared, sharp=1000.0) for shared in ((0, -0.2), (0, 0.0)))
    assets = {f"i{name}": one for name, one in ill.items()} | {f"w{name}": one for name, one in well.items()}
    groups = {name: {"supply": "S1" if name[0] == "i" else "S2", "site": "north"} for name in assets}
    found = causes(assets, groups)
    assert (found[0].key, found[0].group) == ("supply", "S1") and found[0].probability > 0.99
    assert all(cause.probability < 0.05 for cause in found[1:])
    assert not any(set(cause.members) & set(found[0].members) for cause in found[1:])


def test_two_members_are_no_group_and_no_evidence_says_nothing() -> None:
    nothing = Evidence(NAMES, (0.0,) * 4, ((0.0,) * 4,) * 4)
    assert causes({"a": nothing, "b": nothing}, {"a": {"s": "1"}, "b": {"s": "1"}}) == []
    three = dict.fromkeys("abc", nothing)
    assert causes(three, {key: {"s": "1"} for key in three})[0].probability == pytest.approx(Prior().common, rel=1e-3)
    assert fault_probability(nothing) == pytest.approx(Prior().fault)


def test_the_quadrature_is_fine_enough_for_the_sharpest_likelihood() -> None:
    """Halving the grid changes the odds of one change known to a thousandth by less than one in a hundred."""
    rng = np.random.default_rng(5)
    assets = group(rng, 40, Prior(fault=0.0), (0, np.log(0.85)), sharp=1e6)
    fine = causes(assets, one_supply(assets))[0]
    from servoscope.fleet import common_cause

    half = pytest.MonkeyPatch()
    half.setattr(common_cause, "SIZES", SIZES[::2])
    try:
        coarse = causes(assets, one_supply(assets))[0]
    finally:
        half.undo()
    assert coarse.ratio == pytest.approx(fine.ratio, rel=3e-3) and fine.probability == pytest.approx(coarse.probability)


def test_what_the_fleet_knows_of_days_names_the_cause_its_begin_and_who_changed() -> None:
    rng, entries = np.random.default_rng(6), []
    for day in ("1", "2", "3"):
        for i in range(6):
            shared = np.array([-0.2 * (day > "1" and i < 3), 0.3 * (day == "3" and i == 5), 0.0, 0.0])
            told = evidence(rng, shared, information(rng, 2000.0))
            verdict = "fault" if shared.any() else "healthy"
            entry = {"asset": f"a{i}", "day": day, "status": "examined", "error": None, "first_us": 0}
            said = {"verdict": verdict, "summary": verdict, "faults": [], "onset_s": None, "probability": None}
            entries.append({**entry, "diagnosis": said, "evidence": vars(told)})
    entries.append({"asset": "a6", "day": "3", "status": "failed", "error": "x.parquet: is damaged"})
    groups = {f"a{i}": {"supply": "S1" if i < 3 else "S2"} for i in range(6)}
    fleet = summarise_fleet(sorted(entries, key=lambda e: (e["asset"], e["day"])), groups, {})
    states = {one.asset: (one.before, one.state) for one in fleet.assets}
    assert states["a0"] == ("common cause", "common cause") and states["a5"] == ("healthy", "fault")
    assert states["a4"] == ("healthy", "healthy") and states["a6"] == (None, "failed")
    assert next((c.group, since) for c, since in zip(fleet.causes, fleet.since, strict=True)) == ("S1", "2")
    assert fleet.failed == (("a6", "3", "x.parquet: is damaged"),)
