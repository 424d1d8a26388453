"""Limits of joints and of impacts, as bounds on accelerations."""
