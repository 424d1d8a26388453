"""The quadratic program of a tick and its solvers."""
