"""The command ``servoscope``: thin, it parses, calls and prints."""

import os

# matrices here are tiny: threads of the linear algebra would only wait for each other (a tenth of a verdict's time)
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from servoscope.cli import (  # their commands add themselves to the application
    add,
    alarms,
    assess,
    baseline,
    export,
    fleet,
    init,
    recordings,
    service,
    simulate_design,
    trend,
    web,
)
from servoscope.cli.app import app, group_commands, main

group_commands()

__all__ = [
    "add",
    "alarms",
    "app",
    "assess",
    "baseline",
    "export",
    "fleet",
    "init",
    "main",
    "recordings",
    "service",
    "simulate_design",
    "trend",
    "web",
]
