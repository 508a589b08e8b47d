"""Callbacks beside :class:`~sb3_sparse.SparsityCallback`."""

from sb3_sparse.callbacks.robust_value import RobustValueCallback

__all__ = ["RobustValueCallback"]
