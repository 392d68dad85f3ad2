"""Decoders and readers fed with broken input: what is read, what is refused, and that nothing else ever happens."""
