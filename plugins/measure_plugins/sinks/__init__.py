"""Sinks, one per file."""
