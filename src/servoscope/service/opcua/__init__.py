"""Samples from an OPC UA server, and verdicts offered as one."""
