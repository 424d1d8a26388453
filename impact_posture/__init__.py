"""Impact-robust posture optimization for kinematically redundant robots.

The velocity jump of a rigid impact is ``Δν = M⁻¹(q) Jᵀ n λ``.  This package measures it, finds the posture that
keeps it small under the constraints of a task, shows why, and exports what a controller needs.
"""

__version__ = "0.1.0"
