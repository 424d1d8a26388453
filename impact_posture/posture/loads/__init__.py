"""Torques, thrusts and contact forces that hold a posture."""
