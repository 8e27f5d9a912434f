"""Accuracy, failures and speed of every method a user would compare: `python -m benchmarks`."""
