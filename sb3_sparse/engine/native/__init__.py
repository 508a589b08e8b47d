"""The compiled kernels: C sources, and the module that loads them."""
