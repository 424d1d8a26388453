"""H, G, V, S and E of an impact, as CasADi expressions and computed with Pinocchio."""
