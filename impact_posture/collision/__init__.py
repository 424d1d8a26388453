"""Sphere-swept convex hulls around the shapes of a URDF, and collision checks of the shapes themselves."""
