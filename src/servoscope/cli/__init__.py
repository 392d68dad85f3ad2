"""The command ``servoscope``: thin, it parses, calls and prints."""

import os

# matrices here are tiny: threads of the linear algebra would only wait for each other (a tenth of a verdict's time)
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from servoscope.cli import alarming, commands, fleet, service, unrecorded, web  # they add themselves to the application
from servoscope.cli.app import app, main

__all__ = ["alarming", "app", "commands", "fleet", "main", "service", "unrecorded", "web"]
