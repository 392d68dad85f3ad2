"""Discoveries in a fleet: few names are wrong, however much the assets have in common, and the ill ones are named."""

from __future__ import annotations

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.fleet.common_cause import Evidence
from servoscope.fleet.summary import RATE, discover

J = np.array([[900.0, 300.0], [300.0, 400.0]])  # what a recording tells of two parameters: 3.3 and 5 %
ROOT = np.linalg.cholesky(J)


def evidence(score: FloatArray) -> Evidence:
    return Evidence(("C_ie", "p_s"), tuple(score.tolist()), tuple(map(tuple, J.tolist())))


def draw(rng: np.random.Generator, assets: int, ill: int, size: float, common: float) -> dict[str, Evidence]:
    """Scores as a fleet has them: noise of each asset, a share of it common to all, and the first ones changed."""
    noise = np.sqrt(1.0 - common) * rng.standard_normal((assets, 2)) + np.sqrt(common) * rng.standard_normal(2)
    scores = noise @ ROOT.T
    scores[:ill] += size * J[0]
    return {f"asset-{i:03d}": evidence(score) for i, score in enumerate(scores)}


def test_healthy_evidence_is_one_on_average() -> None:
    """The expectation of a likelihood ratio under the hypothesis in its denominator, which the rate rests upon."""
    from servoscope.fleet.common_cause import log_fault_evidence

    found = [np.exp(log_fault_evidence(one)) for one in draw(np.random.default_rng(1), 20000, 0, 0.0, 0.0).values()]
    assert np.mean(found) < 1.0 + 3.0 * np.std(found) / np.sqrt(len(found))


def test_the_rate_holds_whatever_the_assets_have_in_common() -> None:
    for common in (0.0, 0.5, 0.95):
        rng, shares, power = np.random.default_rng(2), [], []
        for _ in range(400):
            named = discover(draw(rng, 40, 4, 0.3, common))
            wrong = sum(int(one[-3:]) >= 4 for one in named)
            shares.append(wrong / max(len(named), 1))
            power.append((len(named) - wrong) / 4.0)
        assert np.mean(shares) <= RATE + 2.0 * np.std(shares) / 20.0
        assert np.mean(power) > 0.9


def test_none_of_a_healthy_fleet_is_named_in_nineteen_of_twenty_fleets() -> None:
    rng = np.random.default_rng(3)
    assert np.mean([bool(discover(draw(rng, 30, 0, 0.0, 0.5))) for _ in range(400)]) <= RATE


def test_the_surest_stand_first_and_nobody_is_named_for_nothing() -> None:
    fleet = {"weak": evidence(0.25 * J[0]), "strong": evidence(0.5 * J[1]), "none": evidence(0.0 * J[0])}
    assert discover(fleet) == ("strong", "weak")
    assert discover({"still": Evidence(("C_ie",), (0.0,), ((0.0,),))}) == ()
    assert discover({}) == ()
