"""Gymnasium wrappers."""

from sb3_sparse.wrappers.noise import ObservationNoise, PixelNoise

__all__ = ["ObservationNoise", "PixelNoise"]
