"""H and ∇H on a GPU, beside the same functions on all cores and other packages."""
