"""Compare the numbers of the verdict with a small simulation of the impact."""
