"""SB3's algorithms with gradient steps that run in one call of the kernels."""
