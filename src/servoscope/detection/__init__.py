"""Is it healthy: the statistic, the sequential test, their thresholds, and the baseline that they compare with."""
