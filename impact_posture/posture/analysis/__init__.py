"""Verdict, caveats, trade-off, robustness and the result document."""
