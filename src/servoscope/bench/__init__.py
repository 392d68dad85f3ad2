"""How fast it runs, beside the machine's own limits and other libraries, measured in one go on one machine."""

from servoscope.bench.measuring import Figure, Measured, interleaved
from servoscope.bench.running import Result, run

__all__ = ["Figure", "Measured", "Result", "interleaved", "run"]
