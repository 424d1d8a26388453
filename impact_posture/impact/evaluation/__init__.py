"""All quantities of one impact at one posture."""
