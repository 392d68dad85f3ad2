"""The paper's conditions: rig, loop, noise, reference and Table 2, and the settings of its method and of ours."""

from __future__ import annotations

import functools
import tomllib
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from servoscope.core.arrays import FloatArray
from servoscope.models.loop import Loop
from servoscope.models.plants.eha import EHA
from servoscope.signals import Recording
from servoscope.simulation import FaultEvent, reference, simulate
from servoscope.simulation.measurement import NOISE_U_STD, NOISE_Y_STD

DURATION = 60.0  # s
FAULT_AT = 30.0  # s
FREQUENCIES = (1.0, 10.0, 20.0)  # Hz, of Gamma
SIZES = {
    "p_s": (0.6, 0.8, 1.2, 1.4),
    "C_ie": (1.1, 1.2, 1.3, 1.4),
    "b_p": (10.0, 20.0, 30.0, 40.0),
    "beta": (0.005, 0.01, 0.1, 10.0),
}
FAULT_NAMES = {"p_s": "pump", "C_ie": "leakage", "b_p": "friction", "beta": "contamination"}
MEMORY = {"akf": 10.0, "dfrls": 3.96}
"""Memory of the paper's method [s], which leaves its tuning open: alike in speed (see `tradeoff`); for DFRLS it is the
usual forgetting factor of 0.99, l = N/(N + 4)."""


@dataclass(frozen=True)
class FaultCase:
    """One row and size of Table 2; a fault that steps in at 30 s and stays."""

    parameter: str
    ratio: float

    @property
    def fault(self) -> str:
        """Its name: pump, leakage, friction, contamination."""
        return FAULT_NAMES[self.parameter]

    @property
    def event(self) -> FaultEvent:
        """What is simulated."""
        return FaultEvent(self.parameter, self.ratio, FAULT_AT)

    def __str__(self) -> str:
        """Return ``beta x0.005``."""
        return f"{self.parameter} x{self.ratio:g}"


TABLE_2 = tuple(FaultCase(parameter, ratio) for parameter, ratios in SIZES.items() for ratio in ratios)
TRACKING_CASE = FaultCase("p_s", 1.4)  # the fault of Fig. 6


@functools.cache
def _rig_settings() -> dict[str, Any]:
    return tomllib.loads(files("servoscope").joinpath("simulation", "reference-rig.toml").read_text(encoding="utf-8"))


def rig_loop(**monitor: Any) -> Loop:
    """Return the loop of the reference rig with some monitor settings."""
    return Loop.from_dict({**_rig_settings(), "monitor": monitor})


def rig_plant() -> EHA:
    """Return the actuator of the reference rig."""
    plant = rig_loop().plant
    if not isinstance(plant, EHA):
        raise TypeError("the reference rig is an electrohydraulic actuator")
    return plant


def paper_loop(estimator: str = "akf", memory: float | None = None, **monitor: Any) -> Loop:
    """Return the paper's own method as settings: Tustin as printed, stage 1 in front, AKF or DFRLS."""
    chosen = MEMORY.get(estimator, 10.0) if memory is None else memory
    settings = {"structure": "tustin", "two_stage": "adaptive", "frequencies": FREQUENCIES}
    return rig_loop(**{**settings, "estimator": estimator, "memory": chosen, **monitor})


def default_loop() -> Loop:
    """Return this project's default settings."""
    return rig_loop(frequencies=FREQUENCIES)


@dataclass(frozen=True)
class OperatingConditions:
    """Operating conditions: reference and its amplitude, and the noise as a multiple of the paper's."""

    reference: str = "profile"
    amplitude: float = 1.0
    noise: float = 1.0

    def __str__(self) -> str:
        """Return ``profile``, and what differs from the paper."""
        details = [f"amplitude x{self.amplitude:g}"] if self.amplitude != 1.0 else []
        details += [f"noise x{self.noise:g}"] if self.noise != 1.0 else []
        return ", ".join([self.reference, *details])

    def reference_signal(self) -> FloatArray:
        """Return the reference [m], shape (6000,)."""
        return reference(self.reference, DURATION, _rig_settings()["sample_rate"], amplitude=self.amplitude)

    def simulate(self, loop: Loop, seed: int, case: FaultCase | None = None) -> Recording:
        """Simulate 60 s of the loop, healthy or with one fault."""
        events = () if case is None else (case.event,)
        noise = {"noise_u_std": self.noise * NOISE_U_STD, "noise_y_std": self.noise * NOISE_Y_STD}
        return simulate(loop, self.reference_signal(), faults=events, seed=seed, **noise)[0]


PAPER = OperatingConditions()
