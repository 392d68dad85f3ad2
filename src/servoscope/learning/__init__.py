"""Healthy recordings to a baseline; inspection of recordings."""
