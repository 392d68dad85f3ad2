"""Whether the data of an endless stream are sound: silence, standstill, gaps, jitter, sample rate, clock.

limits = QualitySettings.model_validate(section).limits(loop.sample_rate)
state = init()
state, findings = examine(limits, state, t, r, u, y)    # each block
state, findings = tick(limits, state, now)              # each second, and with each block
verdict = judged(verdict, standing(state))              # never healthy on bad data
"""

from servoscope.quality.findings import KINDS, Finding, judged, told
from servoscope.quality.settings import Limits, QualitySettings
from servoscope.quality.watching import examine, init, listen, standing, tick

__all__ = [
    "KINDS",
    "Finding",
    "Limits",
    "QualitySettings",
    "examine",
    "init",
    "judged",
    "listen",
    "standing",
    "tick",
    "told",
]
