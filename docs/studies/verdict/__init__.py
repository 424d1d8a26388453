"""Check the numbers of the verdict against a small simulation of the impact."""
