"""Parameters of plants from recordings: the exact predictor, and one search for the likeliest."""
