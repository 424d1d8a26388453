"""Parts of ``kernel_times``: H and ∇H by this project's C and by its peers, at the same configurations."""
