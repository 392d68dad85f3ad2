"""How the pages bear many assets and many readers; see run.py."""
