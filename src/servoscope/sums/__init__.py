"""One evidence for regressions: sums over blocks, changes of coefficients with their times, causes and sizes."""
