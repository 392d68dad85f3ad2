"""How good a detector or a diagnosis is: pure functions on arrays, and dummies to put beside the real thing."""

from servoscope.scoring.alarms import Detections, alarm_rate, detections, events
from servoscope.scoring.dummies import DUMMIES, Detector, always, cusum, never
from servoscope.scoring.intervals import Measured, coverage, discoveries, share
from servoscope.scoring.isolation import Reliability, accuracy, brier_score, confusion, log_score, reliability
from servoscope.scoring.runlength import (
    RunLengths,
    brook_evans,
    lorden_bound,
    needed_information,
    run_lengths,
    shortest_delay,
    siegmund,
    two_sided,
)

__all__ = [
    "DUMMIES",
    "Detections",
    "Detector",
    "Measured",
    "Reliability",
    "RunLengths",
    "accuracy",
    "alarm_rate",
    "always",
    "brier_score",
    "brook_evans",
    "confusion",
    "coverage",
    "cusum",
    "detections",
    "discoveries",
    "events",
    "log_score",
    "lorden_bound",
    "needed_information",
    "never",
    "reliability",
    "run_lengths",
    "share",
    "shortest_delay",
    "siegmund",
    "two_sided",
]
