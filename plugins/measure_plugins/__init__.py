"""The built-in plugins: one per file, found by entry point like anybody's."""
