"""Benchmarks that anyone can repeat: official protocols and metrics, servoscope beside simple detectors."""
