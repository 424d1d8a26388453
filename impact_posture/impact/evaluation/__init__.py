"""All quantities and predictions of one impact at one posture."""
