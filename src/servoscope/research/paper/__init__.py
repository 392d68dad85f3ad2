"""The source paper: its method as settings, its table and figures, and what becomes of its claims when measured."""
