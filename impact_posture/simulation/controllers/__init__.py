"""The controllers that a simulation compares."""
