"""What the tests of exports share."""

from __future__ import annotations

import shutil
import subprocess

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_sparse.export.graph import Graph
from sb3_sparse.export.nodes import Activation, Linear

COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")


def linear(value, weight, bias=None):
    weight = np.array(weight, np.float32)
    bias = np.zeros(len(weight), np.float32) if bias is None else np.array(bias, np.float32)
    return Linear((value,), (len(weight),), weight, bias)


def relu(value, units):
    return Activation((value,), (units,), "relu")


def chain(observations, *layers):
    """A graph of linear layers with ReLUs between, from weights and biases."""
    nodes = []
    for weight, bias in layers:
        nodes.append(linear(len(nodes), weight, bias))
        nodes.append(relu(len(nodes), len(weight)))
    return Graph((observations,), tuple(nodes[:-1]), (len(layers[-1][0]),))


def random_chain(random, sizes, density):
    """The same, drawn at random."""
    layers = []
    for inputs, outputs in zip(sizes, sizes[1:], strict=False):
        weight = random.normal(size=(outputs, inputs)) * (
            random.random((outputs, inputs)) < density
        )
        layers.append((weight, random.normal(size=outputs)))
    return chain(sizes[0], *layers)


def compiles(path, *options):
    """What the compiler has to say, with every warning an error."""
    strict = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic"]
    command = [COMPILER, *strict, *options, "-c", str(path), "-o", "/dev/null"]
    done = subprocess.run(command, capture_output=True, text=True)
    return done.stderr


class Task(gym.Env):
    """Observations and actions of any spaces."""

    def __init__(self, observation_space, action_space):
        self.observation_space = observation_space
        self.action_space = action_space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        self.steps = 0
        return self.observation_space.sample(), {}

    def step(self, action):
        self.steps += 1
        return self.observation_space.sample(), float(self.steps), self.steps >= 20, False, {}


VECTOR = spaces.Box(-2, 2, (5,), np.float32)


class OwnExtractor(BaseFeaturesExtractor):
    """As SB3's documentation shows how to write one, with a residual connection."""

    def __init__(self, observation_space, features_dim=16):
        super().__init__(observation_space, features_dim)
        self.first = nn.Sequential(nn.Linear(observation_space.shape[0], features_dim), nn.Tanh())
        self.second = nn.Linear(features_dim, features_dim)

    def forward(self, observations):
        features = self.first(observations)
        return th.relu(features + self.second(features))


class OddExtractor(OwnExtractor):
    """Does what cannot be exported."""

    def forward(self, observations):
        return super().forward(observations) / observations.norm()
