"""Elastic joints, and the compression of the contact."""
