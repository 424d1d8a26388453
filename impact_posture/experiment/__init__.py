"""Runs of scenarios from end to end: one, several side by side, and the paper's table and figures."""
