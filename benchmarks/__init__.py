"""Benchmarks: accuracy, failures and time of every method that users would compare."""
