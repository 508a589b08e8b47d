"""The arithmetic of sparse networks: integers and NumPy arrays in, integers and arrays out.

Example::

    from sb3_sparse.sparsity import active_counts

    active_counts([(256, 17), (256, 256), (6, 256)], sparsity=0.9)  # [1951, 3658, 1536]
"""

from sb3_sparse.sparsity.budgets import split_sparsity
from sb3_sparse.sparsity.distributions import active_counts
from sb3_sparse.sparsity.initialisation import random_mask, sparsity_aware_weights
from sb3_sparse.sparsity.randomness import random_bits, random_uniform
from sb3_sparse.sparsity.schedules import cosine_drop_fraction, pruned_count
from sb3_sparse.sparsity.selection import Indices, largest, least_magnitude
from sb3_sparse.sparsity.widths import equivalent_widths, mlp_parameters

__all__ = [
    "Indices", "active_counts", "cosine_drop_fraction", "equivalent_widths", "largest",
    "least_magnitude", "mlp_parameters", "pruned_count", "random_bits", "random_mask",
    "random_uniform", "sparsity_aware_weights", "split_sparsity",
]  # fmt: skip
