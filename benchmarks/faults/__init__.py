"""Faults of files, cameras, packets and processes, injected for hours."""
