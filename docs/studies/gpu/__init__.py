"""Times of H and ∇H on a GPU, compared with the same functions on all cores and with other packages."""
