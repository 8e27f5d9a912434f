"""A package that adds one command to `measure`."""
