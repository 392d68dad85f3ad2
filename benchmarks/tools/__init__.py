"""What several cases of `speed.py` use: limits of the machine, other libraries, slow doubles, senders."""
