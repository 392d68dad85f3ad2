"""Fleets past one machine: lakes of recordings, engines that carry the estimator, what assets have in common."""

from __future__ import annotations

from servoscope.fleet import sinks as sinks
from servoscope.fleet import spark as spark
from servoscope.fleet.common_cause import Cause, Evidence, Prior, causes
from servoscope.fleet.lake import Lake
from servoscope.fleet.run import Plan, run
from servoscope.fleet.spark import diagnose
from servoscope.fleet.streaming import follow
from servoscope.fleet.summary import Fleet
from servoscope.fleet.tasks import local

__all__ = [
    "Cause",
    "Evidence",
    "Fleet",
    "Lake",
    "Plan",
    "Prior",
    "causes",
    "diagnose",
    "follow",
    "local",
    "run",
    "sinks",
    "spark",
]
