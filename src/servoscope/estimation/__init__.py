"""Recursive estimation of the inverse transfer function: filter bank, estimators, noise model, frequency response."""
