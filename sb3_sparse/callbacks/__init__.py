"""Callbacks beside :class:`~sb3_sparse.SparsityCallback`."""

from sb3_sparse.callbacks.recycle import RecycleDormantCallback
from sb3_sparse.callbacks.reset import ResetCallback
from sb3_sparse.callbacks.robust_value import RobustValueCallback

__all__ = ["RecycleDormantCallback", "ResetCallback", "RobustValueCallback"]
