"""The compiled kernels: C sources, and the one module that calls them."""
