"""Whether the data of an endless stream are sound: silence, standstill, gaps, jitter, sample rate, clock.

limits = QualitySettings.model_validate(section).limits(loop.sample_rate)
state = init_state()
state, findings = check_block(limits, state, t, r, u, y)    # each block
state, findings = tick(limits, state, now)              # each second, and with each block
verdict = limit_verdict(verdict, active_findings(state))              # never healthy on bad data
"""

from servoscope.signals.quality.monitor import (
    ACTIVE,
    active_findings,
    check_block,
    check_lanes,
    init_state,
    restart_silence,
    tick,
    upgrade_state,
)
from servoscope.signals.quality.settings import (
    KINDS,
    QualityFinding,
    QualityLimits,
    QualitySettings,
    describe_findings,
    limit_verdict,
)

__all__ = [
    "ACTIVE",
    "KINDS",
    "QualityFinding",
    "QualityLimits",
    "QualitySettings",
    "active_findings",
    "check_block",
    "check_lanes",
    "describe_findings",
    "init_state",
    "limit_verdict",
    "restart_silence",
    "tick",
    "upgrade_state",
]
