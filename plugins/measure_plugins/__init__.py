"""The built-in plugins: one a file, found by entry point like anybody's."""
