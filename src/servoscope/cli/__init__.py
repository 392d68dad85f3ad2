"""The command ``servoscope``: thin, it parses, calls and prints."""

import os

# matrices here are tiny: threads of the linear algebra would only wait for each other (a tenth of a verdict's time)
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from servoscope.cli import (  # they add themselves to the application
    alarming,
    commands,
    fleet,
    publishing,
    service,
    unrecorded,
    web,
)
from servoscope.cli.app import app, main

__all__ = ["alarming", "app", "commands", "fleet", "main", "publishing", "service", "unrecorded", "web"]
