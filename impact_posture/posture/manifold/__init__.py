"""The constraint manifold: feasible starts, self-motion and bounds."""
