"""The recursion of one sample, a log or a fleet, as compiled code."""
