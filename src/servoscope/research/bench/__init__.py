"""How fast it runs, beside the machine's own limits and other libraries, measured in one go on one machine."""

from servoscope.research.bench.benchmarks import BenchmarkResult, run_benchmarks
from servoscope.research.bench.timing import BenchmarkRow, JobTiming, time_interleaved

__all__ = ["BenchmarkResult", "BenchmarkRow", "JobTiming", "run_benchmarks", "time_interleaved"]
