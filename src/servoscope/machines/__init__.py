"""Machines of any kind, as services, pages, fleets and commands know them: each behind one protocol."""
