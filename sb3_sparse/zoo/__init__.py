"""Training runs in the manner of the RL zoo: configs, runs, and what they leave behind."""

from sb3_sparse.zoo.configs import config_path

__all__ = ["config_path"]
