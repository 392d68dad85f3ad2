"""The source paper reproduced, benchmarks."""
