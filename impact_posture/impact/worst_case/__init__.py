"""The inner maximum over normals, impulses or models."""
