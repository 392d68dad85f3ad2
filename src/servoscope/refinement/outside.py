"""Parameters outside the list of faults: what their change would explain, by the same fit as a fault's."""

from __future__ import annotations

from servoscope.plants import Fault
from servoscope.refinement.hypotheses import Fitted, fit, freed
from servoscope.refinement.starts import Ladder
from servoscope.refinement.window import SENSOR_GAIN, Growth, Window

RANGE = (0.3, 3.0)  # of the ratios that are tried


def outside(window: Window, growth: Growth, best: Fitted, louder: float) -> list[Fitted]:
    """Fit every further parameter of the plant, and the gain of the sensor of y.

    Parameters
    ----------
    window, growth
        What is asked, and when the change came.
    best
        The best hypothesis so far, from whose healthy parameters the searches begin.
    louder
        Variance of the innovations under it.
    """
    known = {**window.plant.causes, SENSOR_GAIN: "a gain error of the sensor of y"}
    found = []
    for name, words in known.items():
        fault = Fault(name, name, RANGE, words)
        starts = Ladder.of(window, fault, best.d).valleys(window, growth)
        found.append(fit(window, [fault], growth, best.d, starts, free=False))
    return freed(window, found, louder, best.J)
