"""Plants: golden numbers of the rig, the closed-form inversion, polynomial plants, refused settings."""

from __future__ import annotations

from typing import Any

import numpy as np
import pydantic
import pytest

from servoscope.core.errors import LoopError
from servoscope.models.plants import Column, Plant, parse_plant, plant_kinds
from servoscope.models.plants.eha import EHA
from servoscope.models.plants.polynomial import PolynomialPlant

# The digits that the theory prints; half a unit in the last place is allowed.
THETA = (0.25993328, 0.26384534, 5.51928887e-5, 3.24664051e-7)
RESPONSE = {1.0: 0.257754 + 1.657709j, 10.0: 0.042040 + 16.497358j, 20.0: -0.611638 + 32.511519j}
TUSTIN = (57.83402840, 43.54921424, -46.40504564, -52.89873074)

RIG: dict[str, Any] = {
    "kind": "eha",
    "m_p": 4.0,
    "b_p": 200.0,
    "k_p": 4.0 * (2.0 * np.pi * 13.0) ** 2,
    "A_p": 4e-4,
    "V_o": 1e-4,
    "beta": 1e9,
    "C_ie": 6e-12,
    "p_s": 14e6,
    "rho": 850.0,
    "C_d": 0.6,
    "W": 0.02,
    "K_m": 1e-3,
}
AXIS = {"inertia": 95.0, "viscous_friction": 203.5, "coulomb_friction": 20.4, "offset": -3.2}


@pytest.fixture
def eha() -> EHA:
    return EHA.model_validate(RIG)


def tustin(theta: np.ndarray, sample_rate: float) -> np.ndarray:
    """Coefficients c of (3): sum theta_i (2 f_s)^i (1-q)^i (1+q)^(3-i)."""
    total = np.polynomial.Polynomial([0.0])
    down, up = np.polynomial.Polynomial([1.0, -1.0]), np.polynomial.Polynomial([1.0, 1.0])
    for i, value in enumerate(theta):
        total = total + value * (2.0 * sample_rate) ** i * down**i * up ** (3 - i)
    return total.coef


@pytest.mark.parametrize("friction", ["none", "directional", "eha"])
def test_many_plants_at_once_are_each_of_them_alone(eha: EHA, friction: Any) -> None:
    """Real parameters and complex ones, as derivatives have them."""
    plant: Plant = eha
    names: tuple[str, ...] = ("C_ie", "p_s", "m_p")
    if friction != "eha":
        plant = PolynomialPlant(order=3, stiffness=True, friction=friction)
        names = (plant.names[0], "inertia", "input_gain")
        plant = plant.model_copy(update={"coefficients": {name: 2.0 + i for i, name in enumerate(plant.names)}})
    for imaginary in (0.0, 1e-30j):
        factors = dict(zip(names, np.exp([[0.0, 0.3, -1.0], [0.1, 0.0, 2.0], [0.0, 0.0, imaginary]]), strict=True))
        for mine, slow in zip(plant.state_spaces(factors, 3), Plant.state_spaces(plant, factors, 3), strict=True):
            assert mine == pytest.approx(slow, rel=1e-14)
            assert mine.imag == pytest.approx(slow.imag, rel=1e-14)


class TestEHA:
    def test_theta(self, eha: EHA) -> None:
        assert eha.theta() == pytest.approx(THETA, rel=1e-6)

    def test_poles(self, eha: EHA) -> None:
        poles = np.linalg.eigvals(eha.state_space()[0])
        frequencies = np.sort(np.abs(poles)) / (2.0 * np.pi)
        assert frequencies[0] == pytest.approx(0.157, abs=5e-4)
        assert frequencies[1:] == pytest.approx([143.5, 143.5], abs=0.05)

    def test_frequency_response(self, eha: EHA) -> None:
        found = eha.frequency_response(list(RESPONSE))
        golden = np.array(list(RESPONSE.values()))
        assert np.abs(found - golden) == pytest.approx(0.0, abs=7.1e-7)

    def test_tustin_coefficients(self, eha: EHA) -> None:
        assert tustin(eha.theta(), 100.0) == pytest.approx(TUSTIN, rel=1e-6)

    def test_state_space_is_the_inverse_of_theta(self, eha: EHA) -> None:
        A, B, C = eha.state_space()
        f = np.array([0.01, 1.0, 13.0, 143.0])
        G = [(C @ np.linalg.solve(2j * np.pi * x * np.eye(3) - A, B))[0, 0] for x in f]
        assert np.abs(np.array(G) * eha.frequency_response(f) - 1.0).max() < 1e-9

    def test_vocabulary(self, eha: EHA) -> None:
        assert [fault.name for fault in eha.faults] == ["pump", "leakage", "friction", "contamination"]
        assert eha.parameters == ("p_s", "C_ie", "b_p", "beta")
        assert eha.powers == (0, 1, 2, 3)
        assert eha.extras == ()
        assert eha.input_gain == 1.0

    def test_ratios_multiply_and_leave_the_plant_alone(self, eha: EHA) -> None:
        faulty = eha.with_ratios({"C_ie": 1.2, "b_p": 20.0})
        assert (faulty.C_ie, faulty.b_p, faulty.p_s) == pytest.approx((7.2e-12, 4000.0, 14e6))
        assert eha.C_ie == 6e-12

    @pytest.mark.parametrize("ratios", [{"m_p": 2.0}, {"C_ie": 0.0}, {"C_ie": -1.0}, {"beta": float("nan")}])
    def test_impossible_ratios(self, eha: EHA, ratios: dict[str, float]) -> None:
        with pytest.raises(LoopError, match=next(iter(ratios))):
            eha.with_ratios(ratios)

    def test_gain_parameters_cannot_be_told_apart(self, eha: EHA) -> None:
        pump = eha.with_ratios({"p_s": 1.44}).theta()
        valve = eha.model_copy(update={"K_m": 1.2e-3}).theta()
        assert pump == pytest.approx(valve, rel=1e-12)


class TestWithoutSpring:
    @pytest.fixture
    def free(self) -> EHA:
        return EHA.model_validate(RIG | {"k_p": 0.0})

    def test_it_integrates(self, free: EHA) -> None:
        assert free.theta()[0] == 0.0
        assert np.abs(np.linalg.eigvals(free.state_space()[0])).min() < 1e-9


class TestPolynomial:
    @pytest.mark.parametrize(
        ("settings", "names", "powers", "extras"),
        [
            ({"order": 2}, ("viscous_friction", "inertia"), (1, 2), ()),
            (
                {"order": 4, "stiffness": True},
                ("stiffness", "viscous_friction", "inertia", "jerk", "snap"),
                (0, 1, 2, 3, 4),
                (),
            ),
            (
                {"order": 2, "friction": "coulomb", "offset": True},
                ("viscous_friction", "inertia", "coulomb_friction", "offset"),
                (1, 2),
                ("sign_v", "one"),
            ),
            (
                {"order": 2, "friction": "directional"},
                ("inertia", "viscous_friction_forward", "viscous_friction_backward", "coulomb_friction"),
                (2,),
                ("forward_v", "backward_v", "sign_v"),
            ),
        ],
    )
    def test_columns(
        self,
        settings: dict[str, Any],
        names: tuple[str, ...],
        powers: tuple[int, ...],
        extras: tuple[str, ...],
    ) -> None:
        plant = PolynomialPlant.model_validate(settings)
        assert (plant.names, plant.powers, plant.extras) == (names, powers, extras)
        assert all(isinstance(extra, Column) for extra in plant.extras)
        assert [fault.name for fault in plant.faults] == [*names, "input_gain"]

    def test_without_coefficients_nothing_is_made_up(self) -> None:
        plant = PolynomialPlant(order=2)
        assert not plant.has_physics
        for ask in (plant.theta, plant.state_space, lambda: plant.with_ratios({"inertia": 1.3})):
            with pytest.raises(LoopError, match="coefficients: missing"):
                ask()

    def test_ratios(self) -> None:
        plant = PolynomialPlant(order=2, friction="coulomb", offset=True, coefficients=AXIS)
        heavier = plant.with_ratios({"inertia": 1.3})
        assert heavier.theta() == pytest.approx([203.5, 1.3 * 95.0, 20.4, -3.2])
        weaker = plant.with_ratios({"input_gain": 1.1, "inertia": 2.0})
        assert weaker.theta() == pytest.approx(1.1 * np.array([203.5, 190.0, 20.4, -3.2]))

    def test_state_space(self) -> None:
        plant = PolynomialPlant(
            order=2,
            stiffness=True,
            input_gain=5.0,
            coefficients={"stiffness": 8.0, "viscous_friction": 4.0, "inertia": 2.0},
        )
        A, B, C = plant.state_space()
        assert A.tolist() == [[0.0, 1.0], [-4.0, -2.0]]
        assert (B.tolist(), C.tolist()) == ([[0.0], [2.5]], [[1.0, 0.0]])

    @pytest.mark.parametrize(
        ("coefficients", "message"),
        [
            ({"inertia": 1.0}, "check viscous_friction"),
            ({"inertia": 1.0, "viscous_friction": 1.0, "friction": 2.0}, "check friction"),
            ({"inertia": 0.0, "viscous_friction": 1.0}, "inertia must not be 0, it is the highest power"),
            ({"inertia": 1.0, "viscous_friction": -1.0}, "negative"),
        ],
    )
    def test_coefficients_that_do_not_fit(self, coefficients: dict[str, float], message: str) -> None:
        with pytest.raises(pydantic.ValidationError, match=message):
            PolynomialPlant(order=2, coefficients=coefficients)


class TestParse:
    def test_kinds(self) -> None:
        assert {"eha", "polynomial"} <= set(plant_kinds())

    def test_picks_the_class(self) -> None:
        assert isinstance(parse_plant(RIG), EHA)
        assert isinstance(parse_plant({"kind": "polynomial", "order": 2}), PolynomialPlant)

    @pytest.mark.parametrize("mapping", [{}, {"kind": "motor"}, {"kind": 3}])
    def test_unknown_kind(self, mapping: dict[str, Any]) -> None:
        with pytest.raises(LoopError, match="eha, polynomial"):
            parse_plant(mapping)

    @pytest.mark.parametrize("change", [{"m_p": 0.0}, {"k_p": -1.0}, {"beta": float("inf")}, {"typo": 1.0}])
    def test_impossible_settings(self, change: dict[str, float]) -> None:
        with pytest.raises(pydantic.ValidationError, match=next(iter(change))):
            parse_plant(RIG | change)

    def test_all_twelve_are_required(self) -> None:
        for name in RIG:
            if name != "kind":
                with pytest.raises(pydantic.ValidationError, match=name):
                    parse_plant({key: value for key, value in RIG.items() if key != name})

    def test_frozen(self) -> None:
        plant: Plant = parse_plant(RIG)
        with pytest.raises(pydantic.ValidationError, match="frozen"):
            plant.m_p = 5.0  # type: ignore[attr-defined]
