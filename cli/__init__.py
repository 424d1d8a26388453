"""Command line of impact-posture."""
