"""Gradient steps as programs that the kernels run in one call."""
