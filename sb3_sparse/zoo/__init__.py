"""Training runs in the manner of the RL zoo: configs, runs, and what they leave behind."""

from sb3_sparse.zoo.configs import config_path
from sb3_sparse.zoo.optimize import keep_policy_kwargs

keep_policy_kwargs()

__all__ = ["config_path"]
