"""Impacts of robots with elastic joints, and compression of an elastic contact."""
