"""Drafts of ``robot.toml`` from a URDF."""
