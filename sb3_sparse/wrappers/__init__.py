"""Gymnasium wrappers."""

from sb3_sparse.wrappers.cut import CutEpisodes
from sb3_sparse.wrappers.noise import ObservationNoise, PixelNoise
from sb3_sparse.wrappers.repeat import ActionRepeat

__all__ = ["ActionRepeat", "CutEpisodes", "ObservationNoise", "PixelNoise"]
