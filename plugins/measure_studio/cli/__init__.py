"""`measure studio`."""
