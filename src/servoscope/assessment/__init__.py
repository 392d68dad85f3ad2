"""One log of a loop without a baseline: what is most likely wrong with it, and how sure that is."""
