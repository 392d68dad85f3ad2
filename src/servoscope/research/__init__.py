"""The source paper reproduced, benchmarks, scoring of detectors."""
