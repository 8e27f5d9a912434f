"""Built-in pose solvers."""
