"""Scenes, captures and observations with exact truth that tests and benchmarks measure."""
