"""servoscope listens to a running servo loop and says whether its actuator is healthy: the public names.

    import servoscope as ss

    loop = ss.Loop.load("loop.toml")
    baseline = ss.learn(loop, [ss.read("healthy.csv", loop)])
    diagnosis = ss.diagnose(baseline, ss.read("suspect.csv", loop))

The names are imported when they are first used (PEP 562): ``import servoscope`` costs next to nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

__version__ = "0.1.0"

__all__ = [
    "Baseline",
    "Diagnosis",
    "Loop",
    "Monitor",
    "Recording",
    "Trace",
    "__version__",
    "design_study",
    "diagnose",
    "inspect",
    "learn",
    "read",
    "read_parts",
    "simulate",
]

if TYPE_CHECKING:
    from servoscope.baseline import Baseline
    from servoscope.design import design_study
    from servoscope.diagnosis import Diagnosis, Trace
    from servoscope.inspection import inspect
    from servoscope.loop import Loop
    from servoscope.monitor import Monitor, diagnose
    from servoscope.points import learn
    from servoscope.readers import read, read_parts
    from servoscope.recording import Recording
    from servoscope.simulation import simulate
else:  # hidden from type checkers, which would otherwise accept any name
    _ROOMS = {
        "Baseline": "baseline",
        "Diagnosis": "diagnosis",
        "Loop": "loop",
        "Monitor": "monitor",
        "Recording": "recording",
        "Trace": "diagnosis",
        "design_study": "design",
        "diagnose": "monitor",
        "inspect": "inspection",
        "learn": "points",
        "read": "readers",
        "read_parts": "readers",
        "simulate": "simulation",
    }

    def __getattr__(name: str) -> object:
        if name not in _ROOMS:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        import importlib

        found = getattr(importlib.import_module(f"{__name__}.{_ROOMS[name]}"), name)
        globals()[name] = found  # the next access does not come here
        return found

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__})
