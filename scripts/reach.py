#!/usr/bin/env python3
"""Runs one log through learning, diagnosis and monitor, and prints as JSON what these import and where they call.

For ``scripts/house.py --reach``: the modules of servoscope that are imported by then, and for each package the number
of files of other packages that call into it during one diagnosis.
"""

from __future__ import annotations

import json
import sys
from collections import defaultdict
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

import servoscope as ss
from servoscope.simulation import reference
from servoscope.simulation.faults import FaultEvent

PACKAGE = Path(ss.__file__).parent


def main() -> None:
    """Run as a command."""
    loop = ss.Loop.load(PACKAGE / "simulation" / "reference-rig.toml")
    r = reference("profile", 60.0, loop.sample_rate)
    healthy = ss.simulate(loop, r, seed=1)[0]
    suspect = ss.simulate(loop, r, faults=[FaultEvent.parse("leakage=1.2@30")], seed=2)[0]
    baseline = ss.learn(loop, [healthy])
    callers: dict[str, set[str]] = defaultdict(set)

    def package(frame: FrameType | None) -> str | None:
        path = Path(frame.f_code.co_filename) if frame is not None else PACKAGE
        return path.relative_to(PACKAGE).parts[0] if path.is_relative_to(PACKAGE) and path != PACKAGE else None

    def note(frame: FrameType, event: str, _: Any) -> None:
        if event == "call" and (entered := package(frame)) is not None and frame.f_back is not None:
            caller = package(frame.f_back)
            if caller not in (None, entered):
                callers[entered].add(frame.f_back.f_code.co_filename)

    sys.setprofile(note)
    ss.diagnose(baseline, suspect)
    sys.setprofile(None)
    monitor = ss.Monitor(baseline)
    monitor.run(monitor.init(), *(np.asarray(signal) for signal in (suspect.r, suspect.u, suspect.y)))
    modules = [name.removeprefix("servoscope.") for name in sys.modules if name.startswith("servoscope.")]
    packages = [f"{name}.__init__" for name in modules if getattr(sys.modules[f"servoscope.{name}"], "__path__", None)]
    print(
        json.dumps(
            {"modules": sorted({*modules, *packages}), "callers": {name: len(files) for name, files in callers.items()}}
        )
    )


if __name__ == "__main__":
    main()
