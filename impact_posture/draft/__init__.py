"""Drafts of ``robot.toml`` from a URDF or MJCF."""
