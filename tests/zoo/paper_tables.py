"""The tables at the end of arXiv:2206.10369, copied by hand. None is the paper's dash."""

from __future__ import annotations

METHODS = ("dense", "prune", "static", "rigl", "set")

# Best hyper-parameters: weight decay, update interval, drop fraction, sparsity-aware init.
DQN_SWEEP = {
    "dense": (1e-6, None, None, None),
    "prune": (1e-6, 1000, None, True),
    "static": (1e-6, None, None, True),
    "rigl": (1e-6, 1000, 0.5, True),
    "set": (1e-6, 1000, 0.5, True),
}
SAC_SWEEP = {
    "dense": (1e-4, None, None, None),
    "prune": (1e-4, 1000, None, True),
    "static": (1e-4, None, None, False),
    "rigl": (1e-6, 1000, 0.5, True),
    "set": (1e-4, 250, 0.3, True),
}
PPO_SWEEP = {
    "dense": (1e-6, None, None, None),
    "prune": (1e-6, 500, None, False),
    "static": (0, None, None, True),
    "rigl": (1e-4, 250, 0.3, True),
    "set": (1e-6, 100, 0, True),
}
ATARI_CNN = {
    "dense": (0, None, None, None),
    "prune": (0, 5000, None, False),
    "static": (0, None, None, True),
    "rigl": (0, 5000, 0.3, True),
    "set": (0, 5000, 0.3, True),
}
ATARI_RESNET = {
    "dense": (1e-5, None, None, None),
    "prune": (1e-5, 5000, None, False),
    "static": (1e-5, None, None, True),
    "rigl": (1e-5, 5000, 0.3, True),
    "set": (1e-5, 5000, 0.3, True),
}

# Remaining hyper-parameters, under the names that Stable-Baselines3 has for them.
DQN_CLASSIC = {
    "gamma": 0.99,
    "tau": 1.0,
    "gradient_steps": 1,
    "buffer_size": 10**5,
    "learning_rate": 1e-3,
    "learning_starts": 1000,
    "target_update_interval": 100,
    "train_freq": 1,
    "exploration_final_eps": 0.1,
    "batch_size": 128,
}
DQN_CLASSIC_WIDTHS = [512, 512]
EPSILON_DECAY_STEPS = 2.5e4
DQN_ATARI = {
    "gamma": 0.99,
    "tau": 1.0,
    "gradient_steps": 1,
    "buffer_size": 10**6,
    "learning_starts": 20_000,
    "target_update_interval": 8000,
    "train_freq": 4,
    "exploration_final_eps": 0.01,
    "batch_size": 32,
}
# learning rate, Adam's epsilon
CNN = (2.5e-4, 1e-8)
RESNET = (1e-4, 3.125e-4)
RESNET_FILTERS = [32, 64, 64]
DENSE_UNITS = 512
SAC = {
    "learning_rate": 3e-4,
    "gamma": 0.99,
    "buffer_size": 10**6,
    "batch_size": 256,
    "tau": 0.005,
    "target_update_interval": 1,
    "train_freq": 1,
    "gradient_steps": 1,
}
SAC_WIDTHS = [256, 256]
SAC_STARTS = {
    "Hopper": 1000,
    "Walker2d": 1000,
    "Humanoid": 1000,
    "HalfCheetah": 10000,
    "Ant": 10000,
}
PPO = {
    "learning_rate": 3e-4,
    "gamma": 0.99,
    "n_steps": 2048,
    "batch_size": 64,
    "n_epochs": 10,
    "clip_range": 0.2,
    "gae_lambda": 0.95,
    "ent_coef": 0,
    "vf_coef": 0.5,
    "max_grad_norm": 0.5,
}
PPO_WIDTHS = {"pi": [64, 64], "vf": [64, 64]}

# Training schedule: M environment steps, an evaluation every N, of K episodes.
CLASSIC_SCHEDULE = (100_000, 2000, 20)
MUJOCO_SAC_SCHEDULE = (1_000_000, 10_000, 30)
MUJOCO_PPO_SCHEDULE = (1_000_000, 2000, 20)
ATARI_SCHEDULE = (40_000_000 // 4, 1_000_000 // 4)  # frames; a step of the agent is four

CLASSIC = ("CartPole-v1", "Acrobot-v1", "MountainCar-v0")
MUJOCO = ("HalfCheetah", "Hopper", "Walker2d", "Ant", "Humanoid")
GAMES = (
    ("MsPacman", "Pong", "Qbert", "Assault", "Asterix", "BeamRider", "Boxing", "Breakout")
    + ("CrazyClimber", "DemonAttack", "Enduro", "FishingDerby", "SpaceInvaders", "Tutankham")
    + ("VideoPinball",)
)
