"""The pictures: written in all formats without a warning, and true to the numbers."""
