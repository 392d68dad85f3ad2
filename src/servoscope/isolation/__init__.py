"""Which fault, and how large: signatures, candidates, maximum-likelihood refit."""
