"""A folder with a simulated arm: what a healthy one is, and a log in which the friction of a joint grows."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from servoscope.arm.learning import learn_arm
from servoscope.arm.log import read_arm_log
from servoscope.arm.simulation import URDF, ArmChange, simulate_arm, simulated_arm, simulated_arm_loop

WINDOW_S, ONSET_S, SIZE = 20.0, 45.0, 1.6
FRICTION = "friction of elbow"


def write_arm(folder: Path) -> Path:
    """Write arm.json and run.csv, and return the folder."""
    loop, arm = simulated_arm_loop(), simulated_arm()
    days = [read_arm_log(simulate_arm(seed, 20.0), loop, arm) for seed in range(3)]
    learn_arm(loop, URDF.read_text(encoding="utf-8"), days).save(folder / "arm.json")
    log = simulate_arm(31, 90.0, ArmChange("friction", SIZE, 3, ONSET_S))
    table = np.column_stack(list(log.values()))
    np.savetxt(folder / "run.csv", table, delimiter=",", header=",".join(log), comments="", fmt="%.7g")
    return folder


def arm_hall(folder: Path, name: str, source: str, more: str = "") -> Path:
    """Return the service file of a hall with the arm `cell`, whose samples come from this source."""
    path = folder / f"{name}.toml"
    path.write_text(
        f'name = "hall"\n[service]\nlisten = ""\ncommit_every_s = 0.05\nlog = "error"\n[store]\nurl = "{name}.sqlite"\n'
        f"[diagnosis]\nwindow_s = {WINDOW_S}\n[sources.line]\n{source}\n"
        f'[assets.cell]\nsource = "line"\nbaseline = "arm.json"\n{more}\n',
        encoding="utf-8",
    )
    return path


def replayed_arm(folder: Path, name: str) -> Path:
    """Return the service file of a hall that replays the log, as fast as it can be followed."""
    source = 'kind = "replay"\nstart = 2026-01-01T00:00:00Z\nspeed = 0.0'
    return arm_hall(folder, name, source, 'files = ["run.csv"]')
