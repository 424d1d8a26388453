"""Dynamics of a ``pin.Model``: as CasADi expressions, computed with Pinocchio, and computed with MuJoCo."""
