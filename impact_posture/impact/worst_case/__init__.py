"""The worst case of an impact: the maximum over normals, impulses or robot models."""
