"""Samples that never end: sources, checkpoints, and the service that keeps assets followed for months."""
