"""How far a fault may grow until the loop no longer does its work: the sizes at which a machine is to be stopped."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from servoscope.design.scenario import require_exact_predictor
from servoscope.models.discretise import discretise
from servoscope.models.loop import Loop
from servoscope.models.plants import Fault, Plant
from servoscope.simulation.stability import discrete_closed_loop_poles, require_controller

LimitKind = Literal["tracking", "stability"]
LIMIT_KINDS: tuple[LimitKind, ...] = get_args(LimitKind)
BANDWIDTH_LEFT = 0.7  # of the healthy bandwidth
MARGIN_LEFT = 0.5  # of the healthy distance to the point -1
GRID = 60  # ratios that are tried from healthy to the end of a fault's range
BISECTIONS = 30
FREQUENCIES = 400  # of the margin, up to half of the sample rate


@dataclass(frozen=True)
class OperatingLimit:
    """A fault's ratio to healthy above 1 and below 1 from which on the loop fails; None: nowhere in its range."""

    fault: str
    kind: LimitKind
    up: float | None
    down: float | None

    def side(self, ratio: float) -> float | None:
        """Return the limit on the side of healthy on which a size is."""
        return self.up if ratio >= 1.0 else self.down


def operating_limits(loop: Loop, faults: Sequence[str] | None = None) -> list[OperatingLimit]:
    """Return by fault, or of some faults, the sizes at which tracking, or the margin of stability, is lost.

    Tracking is lost where the bandwidth is 0.7 of the healthy one: the frequency up to which the tracking error, by the
    sensitivity S = 1 / (1 + L), is below 0.707 of the reference (Skogestad and Postlethwaite 2005, section 2.4.5). The
    margin is the smallest distance of L from -1 (Astrom and Murray 2008, section 9.3), and lost where it is half the
    healthy one, or the loop is unstable. Friction, offsets and limits of the actuator are left out.

    Raises LoopError if the loop has no controller, no nominal values, or a plant that is not linear.
    """
    require_exact_predictor(loop)
    performance = functools.cache(
        lambda parameter, x: _performance(loop, loop.plant.with_ratios({parameter: math.exp(x)}))
    )
    return [
        OperatingLimit(fault.name, kind, *(_first_loss(performance, fault, end, kind) for end in (1, 0)))
        for fault in loop.plant.all_faults
        if faults is None or fault.name in faults
        for kind in LIMIT_KINDS
    ]


def _first_loss(
    performance: Callable[[str, float], tuple[float, float]], fault: Fault, end: int, kind: LimitKind
) -> float | None:
    """Return the ratio nearest to 1, towards one end of a fault's range, at which the loop fails."""
    which, left = (0, BANDWIDTH_LEFT) if kind == "tracking" else (1, MARGIN_LEFT)

    def lost(x: float) -> bool:
        return performance(fault.parameter, x)[which] < left * performance(fault.parameter, 0.0)[which]

    stop = math.log(fault.ratio_range[end])
    tried = np.linspace(0.0, stop, GRID + 1)[1:].tolist()
    first = next((i for i, x in enumerate(tried) if lost(x)), None)
    if first is None:
        return None
    sound, bad = (tried[first - 1] if first else 0.0), tried[first]
    for _ in range(BISECTIONS):
        middle = (sound + bad) / 2.0
        sound, bad = (sound, middle) if lost(middle) else (middle, bad)
    return float(f"{math.exp(bad):.3g}")  # no limit is known better


def _performance(loop: Loop, plant: Plant) -> tuple[float, float]:
    """Return the bandwidth [Hz], and the distance of L from -1; 0 and 0 where the loop is unstable."""
    discrete = discretise(plant.state_space(), loop.sample_rate, hold=loop.hold, delay=loop.delay)
    if np.max(np.abs(discrete_closed_loop_poles(loop, discrete))) >= 1.0:
        return 0.0, 0.0
    controller = require_controller(loop)
    frequency = np.geomspace(1e-4, 0.5, FREQUENCIES) * loop.sample_rate
    z = np.exp(2j * np.pi * frequency / loop.sample_rate)
    drive = np.outer(z, discrete.b_next) + discrete.b_now + np.outer(1.0 / z, discrete.b_late)
    states = np.linalg.solve(z[:, None, None] * np.eye(discrete.c.size) - discrete.A, drive[:, :, None])[:, :, 0]
    G = states @ discrete.c * z**-discrete.delay_samples
    distance = np.abs(1.0 + (controller.k_p + controller.k_i / loop.sample_rate * z / (z - 1.0)) * G)  # 1 / |S|
    poor = np.flatnonzero(distance < np.sqrt(2.0))  # the grid's step, 2 %, is finer than any limit is known
    return float(frequency[poor[0]] if poor.size else frequency[-1]), float(distance.min())
