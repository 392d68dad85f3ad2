"""Fleets past one machine: lakes of recordings, engines that carry the estimator, what assets have in common."""

from __future__ import annotations

from servoscope.fleet.common import Cause, Prior, causes
from servoscope.fleet.evidence import Evidence
from servoscope.fleet.knowledge import Fleet
from servoscope.fleet.lake import Lake
from servoscope.fleet.local import local
from servoscope.fleet.running import Plan, run
from servoscope.fleet.spark import diagnose
from servoscope.fleet.streaming import follow

__all__ = ["Cause", "Evidence", "Fleet", "Lake", "Plan", "Prior", "causes", "diagnose", "follow", "local", "run"]
