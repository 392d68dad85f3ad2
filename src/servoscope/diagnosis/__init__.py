"""One recording, or a running loop, against a baseline."""
