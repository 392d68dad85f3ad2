"""Electrohydraulic actuator: voice-coil current [A] to load displacement [m]."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from servoscope.core.arrays import FloatArray
from servoscope.core.settings import NonNegative
from servoscope.models.plants.base import Fault, Plant, StateSpace, matrices, read_translations

PlausiblePositive = Annotated[float, Field(gt=1e-30, lt=1e30, allow_inf_nan=False)]  # SI values beyond are typos

FAULTS = (
    Fault(
        "pump",
        "p_s",
        (0.3, 3.0),
        "pump or valve gain (p_s cannot be told from K_m, C_d, W, rho)",
        "supply pressure and filter; valve and its amplifier: zero, current, contamination",
    ),
    Fault(
        "leakage",
        "C_ie",
        (0.3, 5.0),
        "internal leakage",
        "piston seal and valve edges: warm cylinder, drift under load with the valve shut, oil return flow",
    ),
    Fault(
        "friction", "b_p", (0.2, 100.0), "friction", "rod seal, guide and bearing: alignment, lubrication, side load"
    ),
    Fault(
        "contamination",
        "beta",
        (0.001, 30.0),
        "oil contamination (bulk modulus)",
        "oil: air in it, foam, water, age; oil level and suction line",
    ),
)

OTHER_CAUSES = {"m_p": "another mass", "k_p": "another stiffness of the load", "A_p": "another piston area"}


class EHA(Plant):
    """Valve-controlled hydraulic cylinder with mass, friction and spring.

    ::

        m_p y'' = A_p p_L - b_p y' - k_p y
        V_o/(2 beta) p_L' = K_q u - (C_ie + K_c) p_L - A_p y',   K_q = K_m C_d W sqrt(p_s/rho)
        1/G(s) = ((V_o/(2 beta) s + C_ie + K_c)(m_p s^2 + b_p s + k_p) + A_p^2 s)/(A_p K_q)      (1), (2)

    With a smaller area a A_p on the rod's side, p_L = p_A - a p_B. In steady motion the edges of the valve share the
    pressure so that K_q grows by sqrt(2/(1 + a^3)) for u > 0 and by sqrt(a) of that for u < 0; leakage grows by
    (1 + a)/(1 + a^3), and V_o/(2 beta) becomes V_o/((1 + a^2) beta) (Jelali and Kroll, 2003, chapter 4).
    """

    names: ClassVar[tuple[str, ...]] = ("theta_0", "theta_1", "theta_2", "theta_3")
    units: ClassVar[tuple[str, str]] = ("m", "A")
    powers: ClassVar[tuple[int, ...]] = (0, 1, 2, 3)
    has_physics: ClassVar[bool] = True
    faults: ClassVar[tuple[Fault, ...]] = FAULTS
    causes: ClassVar[Mapping[str, str]] = OTHER_CAUSES
    translations: ClassVar[Mapping[str, Mapping[str, str]]] = read_translations(__file__)

    kind: Literal["eha"] = "eha"
    m_p: PlausiblePositive  # mass [kg]
    b_p: PlausiblePositive  # viscous friction [N s/m]
    k_p: NonNegative  # stiffness of the load [N/m]; 0 for a cylinder without a spring, whose theta_0 is 0
    A_p: PlausiblePositive  # piston area [m^2], that which u > 0 fills
    # area of the rod's side [m^2]; None: both are A_p
    A_b: Annotated[PlausiblePositive | None, Field(exclude_if=lambda value: value is None)] = None
    V_o: PlausiblePositive  # oil volume [m^3]
    beta: PlausiblePositive  # bulk modulus of the oil [Pa]
    C_ie: PlausiblePositive  # leakage [m^3/(s Pa)]
    p_s: PlausiblePositive  # supply pressure [Pa]
    rho: PlausiblePositive  # density of the oil [kg/m^3]
    C_d: PlausiblePositive  # discharge coefficient of the valve [1]
    W: PlausiblePositive  # area gradient of the valve [m]
    K_m: PlausiblePositive  # spool displacement per current [m/A]
    # flow-pressure coefficient of the valve [m^3/(s Pa)], by which its flow falls with the load (Merritt, 1967)
    K_c: Annotated[NonNegative, Field(exclude_if=lambda value: value == 0.0)] = 0.0
    # ``square-root``: the flow is K_q u sqrt(1 - sign(u) p_L/p_s), with the coefficients as they are; ``linear``: it is
    # K_q u
    valve_law: Literal["linear", "square-root"] = "linear"
    # coulomb friction [N] beside b_p y'. Simulations know it, and with them expectations and signatures; the
    # coefficients do not.
    coulomb: NonNegative = 0.0

    @model_validator(mode="before")
    @classmethod
    def _areas_of_diameters(cls, data: Any) -> Any:
        """Take ``bore`` and ``rod`` [m], as data sheets have them, for the areas."""
        if not isinstance(data, Mapping) or not {"bore", "rod"} & data.keys():
            return data
        values = {key: data.get(key) for key in ("bore", "rod")}
        sizes = [value for value in values.values() if isinstance(value, int | float)]
        if len(sizes) < len(values) or not 0.0 <= sizes[1] < sizes[0] or {"A_p", "A_b"} & data.keys():
            raise ValueError("bore, rod: give both diameters [m], bore the larger, in the place of A_p and A_b")
        quarter = math.pi / 4.0
        areas = {"A_p": quarter * sizes[0] ** 2, "A_b": quarter * (sizes[0] ** 2 - sizes[1] ** 2)}
        return {key: value for key, value in data.items() if key not in values} | areas

    @model_validator(mode="after")
    def _rod_takes_area(self) -> Self:
        if self.A_b is not None and self.A_b > self.A_p:
            raise ValueError("A_b: must not be larger than A_p, the side that u > 0 fills: turn the sign of input_gain")
        return self

    @property
    def area_ratio(self) -> float:
        """The rod's area over the other."""
        ratio: float = 1.0 if self.A_b is None else self.A_b / self.A_p
        return ratio

    @property
    def retraction_gain(self) -> float:
        """The flow for u < 0 over that for u > 0, at no load."""
        return float(np.sqrt(self.area_ratio))

    @property
    def error_factors(self) -> Mapping[str, float]:
        """Errors of rho, C_d, W and K_m look like some of p_s, whose root counts; those of V_o like some of beta."""
        return {"p_s": math.sqrt(1.0 + 1.0 + 3.0 * 2.0**2), "beta": math.sqrt(2.0)}

    @property
    def linear(self) -> bool:
        """Whether `state_space` says all: no square root, no Coulomb friction."""
        return self.valve_law == "linear" and self.coulomb == 0.0

    @property
    def load_pressure(self) -> tuple[float, float, float] | None:
        """By the balance of forces p_L = (m_p y'' + b_p y' + k_p y)/A_p."""
        if self.valve_law == "linear":
            return None
        k, b, m = (value / (self.A_p * self.p_s) for value in (self.k_p, self.b_p, self.m_p))
        return k, b, m

    @property
    def flow_gain(self) -> float:
        """K_q = K_m C_d W sqrt(p_s/rho) [m^3/(s A)], for u > 0 and two areas as the class says."""
        both = np.sqrt(2.0 / (1.0 + self.area_ratio**3))
        flow_gain: float = self.K_m * self.C_d * self.W * np.sqrt(self.p_s / self.rho) * both  # complex as `scaled` is
        return flow_gain

    @property
    def capacity(self) -> float:
        """Hydraulic capacity V_o/(2 beta) [m^3/Pa], V_o/((1 + a^2) beta) with two areas."""
        return self.V_o / ((1.0 + self.area_ratio**2) * self.beta)

    @property
    def leakage_share(self) -> float:
        """What of C_ie is lost by p_L: more than all with two areas."""
        return (1.0 + self.area_ratio) / (1.0 + self.area_ratio**3)

    def theta(self) -> FloatArray:
        """Coefficients of 1/G, shape (4,) [A/m, A s/m, A s^2/m, A s^3/m], eq. (2)."""
        capacity, leakage = self.capacity, self.leakage_share * self.C_ie + self.K_c
        coefficients = [
            leakage * self.k_p,
            capacity * self.k_p + leakage * self.b_p + self.A_p**2,
            capacity * self.b_p + leakage * self.m_p,
            capacity * self.m_p,
        ]
        return np.array(coefficients) / (self.A_p * self.flow_gain)

    def scaled(self, factors: Mapping[str, Any]) -> Self:
        """Return the same plant with any of the twelve parameters multiplied, both areas alike."""
        moved = {name: getattr(self, name) * factor for name, factor in factors.items()}
        if self.A_b is not None and "A_p" in factors:
            moved["A_b"] = self.A_b * factors["A_p"]
        return self.model_copy(update=moved)

    def state_spaces(self, factors: Mapping[str, Any], count: int) -> StateSpace:
        """Return those of so many actuators at once; states y [m], y' [m/s], p_L [Pa], integrating if k_p = 0.

        Where the actuator is not `linear` this is the linear part: flow at p_L = 0, no Coulomb friction.
        """
        eha = self.scaled(factors)
        m_p, capacity = eha.m_p, eha.capacity
        A = [
            [0.0, 1.0, 0.0],
            [-eha.k_p / m_p, -eha.b_p / m_p, eha.A_p / m_p],
            [0.0, -eha.A_p / capacity, -(eha.leakage_share * eha.C_ie + eha.K_c) / capacity],
        ]
        B = [[0.0], [0.0], [eha.input_gain * eha.flow_gain / capacity]]
        return matrices(A, count), matrices(B, count), matrices([[1.0, 0.0, 0.0]], count)

    def frequency_response(self, f_hz: npt.ArrayLike) -> npt.NDArray[np.complex128]:
        """Inverse frequency response H(j 2 pi f) [A/m] at frequencies [Hz], same shape as `f_hz`, eq. (2)."""
        s = 2j * np.pi * np.asarray(f_hz, dtype=np.float64)
        return np.asarray(np.polyval(self.theta()[::-1], s), dtype=np.complex128)
