"""servoscope listens to a running servo loop and says whether its actuator is healthy: the public names.

    import servoscope as ss

    loop = ss.Loop.load("loop.toml")
    baseline = ss.learn(loop, [ss.read("healthy.csv", loop)])
    diagnosis = ss.diagnose(baseline, ss.read("suspect.csv", loop))

The names are imported when they are first used (PEP 562): ``import servoscope`` costs next to nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

__version__ = "1.0.0"

__all__ = [
    "Assessment",
    "Baseline",
    "Columns",
    "Diagnosis",
    "Loop",
    "Monitor",
    "Recording",
    "ServoscopeError",
    "Trace",
    "__version__",
    "assess",
    "design_study",
    "diagnose",
    "init",
    "inspect",
    "learn",
    "plot",
    "read",
    "read_parts",
    "relearn",
    "reproduce",
    "simulate",
    "write_report",
]

if TYPE_CHECKING:
    from servoscope.assessment.assess import Assessment, assess
    from servoscope.baseline.baseline import Baseline
    from servoscope.core.errors import ServoscopeError
    from servoscope.design import design_study
    from servoscope.detection.trace import Trace
    from servoscope.diagnosis.diagnose import diagnose
    from servoscope.diagnosis.monitor import Monitor
    from servoscope.diagnosis.novelty import NoveltyDetector as NoveltyDetector
    from servoscope.diagnosis.operating_points import learn
    from servoscope.diagnosis.relearn import relearn
    from servoscope.diagnosis.result import Diagnosis
    from servoscope.learning.inspection import inspect
    from servoscope.learning.proposal import init
    from servoscope.models.loop import Columns, Loop
    from servoscope.report.diagnosis_page import write_report
    from servoscope.report.plots import plot
    from servoscope.research.paper.reproduction import reproduce
    from servoscope.signals.readers import read, read_parts
    from servoscope.signals.recording import Recording
    from servoscope.simulation import simulate
else:  # hidden from type checkers, which would otherwise accept any name
    _HOMES = {
        "Assessment": "assessment.assess",
        "Baseline": "baseline.baseline",
        "Columns": "models.loop",
        "Diagnosis": "diagnosis.result",
        "Loop": "models.loop",
        "Monitor": "diagnosis.monitor",
        "NoveltyDetector": "diagnosis.novelty",  # not in __all__: it needs scikit-learn
        "Recording": "signals.recording",
        "ServoscopeError": "core.errors",
        "Trace": "detection.trace",
        "assess": "assessment.assess",
        "design_study": "design",
        "diagnose": "diagnosis.diagnose",
        "init": "learning.proposal",
        "inspect": "learning.inspection",
        "learn": "diagnosis.operating_points",
        "plot": "report.plots",
        "read": "signals.readers",
        "read_parts": "signals.readers",
        "relearn": "diagnosis.relearn",
        "reproduce": "research.paper.reproduction",
        "simulate": "simulation",
        "write_report": "report.diagnosis_page",
    }

    def __getattr__(name: str) -> object:
        import importlib

        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        public = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
        globals()[name] = public  # the next access does not come here
        return public

    def __dir__() -> list[str]:
        return sorted({*__all__, "NoveltyDetector"})
