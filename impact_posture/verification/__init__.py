"""Every way of computing an impact's quantities, side by side."""
