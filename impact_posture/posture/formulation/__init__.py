"""Build a constrained problem from settings and requirements."""
