"""What healthy looks like: the baseline and its records, and what a healthy loop is expected to show."""
