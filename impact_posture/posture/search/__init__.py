"""The search for the best posture from many starts."""
