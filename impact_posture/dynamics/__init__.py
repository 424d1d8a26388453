"""The same model twice: symbolic (CasADi, from a ``pin.Model``) and numeric (Pinocchio, the oracle)."""
