"""Recordings in which the oil of the rig warms up, with nobody who measures its temperature."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

import servoscope as ss
from servoscope.simulation import FaultEvent, reference
from servoscope.simulation.nonlinear_eha import Rig, simulate_rig

FILE = Path(__file__).parents[2] / "src/servoscope/simulation/reference-rig.toml"
PLAIN = ss.Loop.load(FILE)
LOOP = PLAIN.model_copy(update={"monitor": PLAIN.monitor.model_copy(update={"hidden_warm_up": True})})
HEALTHY = (30.0, 8.0), (35.0, 20.0), (40.0, 30.0)  # degC at the start, and by how many K it would rise in the end


def warm_up(seed: int, start: float, rise: float, *faults: FaultEvent) -> tuple[ss.Recording, np.ndarray]:
    """A minute in which the oil warms with a time constant of a minute, without a thermometer; and its temperature."""
    rig = replace(Rig.ideal(), temperature=start, warming=rise, warming_time=60.0)
    made, truth = simulate_rig(LOOP, reference("profile", 60.0, LOOP.sample_rate), rig, faults=faults, seed=seed)
    return replace(made, name=f"warm-{seed}"), truth.temperature
