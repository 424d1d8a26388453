"""Paths from the start to the optimum, and their timing."""
