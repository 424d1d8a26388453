"""Task-space inverse dynamics at 1 kHz with the impact-robust posture task; imports no CasADi."""
