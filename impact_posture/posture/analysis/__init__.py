"""Verdict, warnings, trade-off, robustness and the result document."""
