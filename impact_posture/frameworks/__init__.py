"""Batches of H, its gradient and the objective on CPU cores or a GPU, for NumPy, CuPy, PyTorch and JAX."""
