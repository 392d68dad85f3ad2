"""The paper's conditions: rig, loop, noise, reference and Table 2, and the settings of its method and of ours."""

from __future__ import annotations

import functools
import tomllib
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from servoscope.loop import Loop
from servoscope.plants import FloatArray
from servoscope.recording import Recording
from servoscope.simulation import FaultEvent, reference, simulate
from servoscope.simulation.closed_loop import NOISE_U_STD, NOISE_Y_STD

DURATION = 60.0  # s
FAULT_AT = 30.0  # s
PERIOD = 10.0  # s, of the reference
FREQUENCIES = (1.0, 10.0, 20.0)  # Hz, of Gamma
SIZES = {
    "p_s": (0.6, 0.8, 1.2, 1.4),
    "C_ie": (1.1, 1.2, 1.3, 1.4),
    "b_p": (10.0, 20.0, 30.0, 40.0),
    "beta": (0.005, 0.01, 0.1, 10.0),
}
WORDS = {"p_s": "pump", "C_ie": "leakage", "b_p": "friction", "beta": "contamination"}
MEMORY = {"akf": 10.0, "dfrls": 3.96}
"""Memory of the paper's method [s], which leaves its tuning open: alike in speed (see `tradeoff`); for DFRLS it is the
usual forgetting factor of 0.99, l = N/(N + 4)."""


@dataclass(frozen=True)
class Case:
    """One row and size of Table 2; a fault that steps in at 30 s and stays."""

    parameter: str
    ratio: float

    @property
    def fault(self) -> str:
        """Its name: pump, leakage, friction, contamination."""
        return WORDS[self.parameter]

    @property
    def event(self) -> FaultEvent:
        """What is simulated."""
        return FaultEvent(self.parameter, self.ratio, FAULT_AT)

    def __str__(self) -> str:
        """Return ``beta x0.005``."""
        return f"{self.parameter} x{self.ratio:g}"


TABLE_2 = tuple(Case(parameter, ratio) for parameter, ratios in SIZES.items() for ratio in ratios)
TRACKED = Case("p_s", 1.4)  # the fault of Fig. 6


@functools.cache
def _rig() -> dict[str, Any]:
    return tomllib.loads(files("servoscope").joinpath("examples", "reference-rig.toml").read_text(encoding="utf-8"))


def rig(**monitor: Any) -> Loop:
    """Return the loop of the reference rig with some monitor settings."""
    return Loop.from_dict({**_rig(), "monitor": monitor})


def paper_loop(estimator: str = "akf", memory: float | None = None, **monitor: Any) -> Loop:
    """Return the paper's own method as settings: Tustin as printed, stage 1 in front, AKF or DFRLS."""
    chosen = MEMORY.get(estimator, 10.0) if memory is None else memory
    settings = {"structure": "tustin", "two_stage": "adaptive", "frequencies": FREQUENCIES}
    return rig(**{**settings, "estimator": estimator, "memory": chosen, **monitor})


def default_loop() -> Loop:
    """Return this project's default settings."""
    return rig(frequencies=FREQUENCIES)


@dataclass(frozen=True)
class Conditions:
    """Operating conditions: reference and its amplitude, and the noise as a multiple of the paper's."""

    reference: str = "profile"
    amplitude: float = 1.0
    noise: float = 1.0

    def __str__(self) -> str:
        """Return ``profile``, and what differs from the paper."""
        more = [f"amplitude x{self.amplitude:g}"] if self.amplitude != 1.0 else []
        more += [f"noise x{self.noise:g}"] if self.noise != 1.0 else []
        return ", ".join([self.reference, *more])

    def r(self) -> FloatArray:
        """Return the reference [m], shape (6000,)."""
        return reference(self.reference, DURATION, _rig()["sample_rate"], amplitude=self.amplitude)

    def record(self, loop: Loop, seed: int, case: Case | None = None) -> Recording:
        """Simulate 60 s of the loop, healthy or with one fault."""
        events = () if case is None else (case.event,)
        noise = {"noise_u_std": self.noise * NOISE_U_STD, "noise_y_std": self.noise * NOISE_Y_STD}
        return simulate(loop, self.r(), faults=events, seed=seed, **noise)[0]


PAPER = Conditions()
