"""H, G, V, S and E of an impact: as expressions and from Pinocchio."""
