"""Sizes over weeks to a remaining time: how a change grows, and until when it stays within a limit."""
