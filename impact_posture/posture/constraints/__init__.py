"""Constraints on a posture."""
