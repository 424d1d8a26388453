"""Tests of controllers, runs and metrics of the experiments."""
