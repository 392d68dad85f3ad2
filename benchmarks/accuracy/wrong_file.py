"""Loop files whose physical parameters are wrong: what is named on the true rig, and whether intervals hold."""

from __future__ import annotations

import functools

import numpy as np

import servoscope as ss
from accuracy.draws import SECONDS, between
from accuracy.rig import FAULT_AT, loop, record
from accuracy.scenario import Numbers, Scenario, Table
from accuracy.told import baseline_rows, told
from servoscope.core.errors import SimulationError
from servoscope.simulation import FaultEvent

WRONG = 1.2  # most that a parameter of the file is off, up or down
PARAMETERS = ("m_p", "b_p", "k_p", "A_p", "V_o", "beta", "C_ie", "p_s", "rho", "C_d", "W", "K_m")
RATIOS = {"p_s": 0.8, "C_ie": 1.3, "b_p": 20.0, "beta": 0.1}
KIND = "multisine"
UNITS = 50


def job(seed: int, wrong: float = WRONG) -> Numbers:
    """Learn with a file of one draw, and diagnose one fault of each kind."""
    drawn, said = wrong_loop(seed, wrong), []
    learned = ss.learn(drawn, [record(KIND, SECONDS, seed, 0)])
    refits = learned.exact is not None and learned.exact.misfit <= 1.0
    for i, (parameter, ratio) in enumerate(RATIOS.items() if refits else ()):
        fault = FaultEvent(parameter, ratio, FAULT_AT)
        said.append(told(learned, record(KIND, SECONDS, seed, 1 + i, (fault,)), [fault]))
    return {"runs": said, "of": len(RATIOS), "sequential": bool(learned.thresholds.hypotheses)}


def wrong_loop(seed: int, wrong: float) -> ss.Loop:
    """Return a file whose parameters are off, log-uniform and independently, and with which the loop is stable."""
    true, rng = loop(), np.random.default_rng(seed)
    while True:
        values = {name: getattr(true.plant, name) * between(rng, 1.0 / wrong, wrong) for name in PARAMETERS}
        drawn = true.model_copy(update={"plant": true.plant.model_copy(update=values)})
        try:
            ss.simulate(drawn, np.zeros(round(SECONDS * true.sample_rate)))
        except SimulationError:
            continue
        return drawn


TABLES = (
    Table(
        "wrong-file",
        (
            *("reference", "files, faults", "with a refit", "with a sequential test"),
            *("detected", "named (95)", "not named, what was said", "size in interval (92 to 98)"),
        ),
        (Scenario(f"wrong-file/{KIND}", KIND, UNITS, job, (), functools.partial(baseline_rows, target=0.95)),),
    ),
)
