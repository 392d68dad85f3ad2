"""The cases of `speed.py`: each module measures one thing, and says so in its first line."""
