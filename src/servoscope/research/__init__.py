"""The source paper reproduced."""
