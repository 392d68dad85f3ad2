"""Months in minutes: how the service stands kills, full disks and crashing databases."""
