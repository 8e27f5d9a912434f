"""Built-in triangulators."""
