"""Verify the quantities of an impact: compute them by different means and compare the results."""
