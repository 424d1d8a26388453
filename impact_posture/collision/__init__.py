"""Collision shapes: sphere-swept convex hulls around the shapes of a URDF, and the check on the shapes themselves."""
