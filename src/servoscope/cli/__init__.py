"""The command ``servoscope``: thin, it parses, calls and prints."""

from servoscope.cli.commands import app, main

__all__ = ["app", "main"]
