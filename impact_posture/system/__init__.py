"""Processes, files, folders, the compiler and the cache."""
