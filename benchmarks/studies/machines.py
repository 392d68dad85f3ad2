"""The recordings of machines that settings are tried on, read once."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

from studies.recordings import RIG, ROOT, Judged

import servoscope as ss

LOADS = ("20", "40", "-40")  # kgf, of the ball screw


class Machines:
    """Loops and recordings of a folder."""

    def __init__(self, data: Path) -> None:
        self.data = data
        self.loops = {name: ss.Loop.load(ROOT / "examples" / f"{name}.toml") for name in ("emps", "qube", "eha-pump")}
        self.loops |= {"rig": ss.Loop.load(RIG), "cranfield": ss.Loop.load(ROOT / "examples" / "cranfield.toml")}

    @cached_property
    def emps(self) -> ss.Recording:
        """The positioning axis."""
        return ss.read(self.data / "real" / "emps" / "DATA_EMPS.mat", self.loops["emps"])

    @cached_property
    def emps_halves(self) -> tuple[ss.Recording, ss.Recording]:
        """Both halves of it."""
        half = self.emps.duration_s / 2.0
        return self.emps.part(0.0, half), self.emps.part(half, self.emps.duration_s + 1.0)

    @cached_property
    def rig(self) -> tuple[ss.Recording, ss.Recording]:
        """The reference rig: healthy, and with a leakage of 20 % from 30 s on."""
        names = ("multisine_healthy_2", "multisine_C_iex1.2_11")
        first, second = (ss.read(self.data / "eha_cases" / f"{name}.csv", self.loops["rig"]) for name in names)
        return first, second

    @cached_property
    def qube(self) -> list[ss.Recording]:
        """Three healthy runs of the pendulum."""
        return [ss.read(path, self.loops["qube"]) for path in sorted((self.data / "real" / "qube").glob("*.csv"))]

    def pump(self, load: int, stroke: int) -> ss.Recording:
        """Return a recording of the pump-controlled cylinder."""
        return ss.read(self.data / "real" / "eha_pump" / f"exp_data_{load}_{stroke}.csv", self.loops["eha-pump"])

    def cranfield(self, name: str, load: str, runs: str) -> list[ss.Recording]:
        """Return runs of the ball screw."""
        path, loop = self.data / "real" / "cranfield" / f"{name}.csv", self.loops["cranfield"]
        return ss.read_parts(path, loop, where={"load": load, "run": runs}, by="run")

    def ball_screw(self, loop: ss.Loop, loads: Sequence[str] = ("40",)) -> tuple[str, str]:
        """Return false alarms in runs 6 to 10, and how many runs without lubrication are found at 40 kgf."""
        false: list[Judged] = []
        found: list[Judged] = []
        for load in loads:
            baseline = ss.learn(loop, self.cranfield("normal", load, "1-5"))
            false += [Judged.of(baseline, one) for one in self.cranfield("normal", load, "6-10")]
            if load == "40":
                found = [Judged.of(baseline, one) for one in self.cranfield("lackLubrication1", load, "1-10")]
        alarms = [sum(one.diagnosis.verdict in ("suspect", "fault") for one in each) for each in (false, found)]
        return f"{alarms[0]} of {len(false)}", f"{alarms[1]} of {len(found)}"
