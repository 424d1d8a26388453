"""Figures: written in all formats without a warning, and consistent with the numbers."""
