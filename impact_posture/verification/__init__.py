"""Comparison of several computations of the quantities of an impact."""
