"""A process that trains models when asked, for end_to_end.py.

``Worker`` starts this file as a program and asks; the program reads one request a line from stdin,
as JSON, and answers each with one line. Whatever a library prints goes to stderr. It imports only
what its models need: an environment with SBX has no sb3_sparse.
"""

from __future__ import annotations

import functools
import gc
import importlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from random_env import IMAGE, RandomEnv

ACTIVATIONS = {"relu": "ReLU", "tanh": "Tanh", "elu": "ELU", "silu": "SiLU"}
"""Classes of torch.nn by name; flax has functions with lower-case names."""
OFF = dict(learning_starts=100, buffer_size=20_000)
PPO = dict(n_steps=2048, batch_size=64, n_epochs=10)
ALGORITHMS: dict[str, tuple[str, dict[str, Any]]] = {
    "sac": ("SAC", OFF),
    "td3": ("TD3", OFF),
    "ddpg": ("DDPG", OFF),
    "tqc": ("TQC", OFF),
    "crossq": ("CrossQ", OFF),
    "qrdqn": ("QRDQN", dict(OFF, train_freq=1, batch_size=128)),
    "dqn": ("DQN", dict(OFF, train_freq=1, batch_size=128)),
    "dqn4": ("DQN", OFF),
    "ppo": ("PPO", PPO),
    "a2c": ("A2C", {}),
    "trpo": ("TRPO", {}),
}
"""Class and settings of each algorithm; everything else is SB3's default, but ``dqn`` and ``qrdqn``
train at every step of the environment."""
IMAGES = {"nature", "impala"}
"""Networks for images."""
NOISE = "noise"
"""Environment whose images are noise."""

MODULES = {
    "stock": ["stable_baselines3", "sb3_contrib"],
    "plug-in": ["stable_baselines3", "sb3_contrib"],
    "ours": ["sb3_sparse"],
    "sbx": ["sbx"],
}
"""The package of each contender's algorithms."""
SPARSE = {"plug-in", "ours"}
"""Contenders with ``SparsePolicy``."""


def algorithm(kind: str, name: str) -> Any:
    """Find a contender's class; None if it has none."""
    for module in MODULES[kind]:
        try:
            found = getattr(importlib.import_module(module), name, None)
        except ModuleNotFoundError as error:
            if error.name != module:
                raise
            found = None
        if found is not None:
            return found
    return None


def network(kind: str, net: str, activation: str | None) -> dict[str, Any]:
    """Make policy arguments for two layers of ``net`` units, or for an image network."""
    found: dict[str, Any] = {}
    if net == "impala":
        from sb3_sparse.networks import ImpalaCNN

        found = dict(features_extractor_class=ImpalaCNN, net_arch=[])
    elif net == "nature":
        found = dict(net_arch=[512]) if kind == "sbx" else {}  # SBX counts the extractor's layer
    else:
        found = dict(net_arch=[int(net), int(net)])
    if activation is not None and kind == "sbx":
        from flax import linen

        found["activation_fn"] = getattr(linen, activation)
    elif activation is not None:
        from torch import nn

        found["activation_fn"] = getattr(nn, ACTIVATIONS[activation])
    return found


def is_atari(env: str) -> bool:
    """Whether it is the name of an Atari game that skips no frames, as SB3's wrapper does."""
    return "NoFrameskip" in env


def environment(env: str) -> Any:
    """Make an environment, or give its name where SB3 can make it.

    :raises SystemExit: if there are no Atari games here
    """
    if env == NOISE:
        from gymnasium import spaces

        return RandomEnv(IMAGE, spaces.Discrete(6))
    if not is_atari(env):
        return env
    try:
        importlib.import_module("ale_py")  # registers the games
        importlib.import_module("cv2")
    except ModuleNotFoundError as error:
        raise SystemExit(f"{env} needs {error.name}: pip install ale-py opencv-python") from None
    from stable_baselines3.common.env_util import make_atari_env
    from stable_baselines3.common.vec_env import VecFrameStack

    return VecFrameStack(make_atari_env(env, seed=0), n_stack=4)


def build(spec: dict[str, Any]) -> Any:
    """Make an untrained model; None if the contender has none of this kind."""
    kind, net = spec["kind"], spec["net"]
    name, settings = ALGORITHMS[spec["algo"]]
    made = algorithm(kind, name)
    images = net in IMAGES
    policy = "CnnPolicy" if images else "MlpPolicy"
    if made is None or policy not in made.policy_aliases or (kind == "sbx" and net == "impala"):
        if kind in ("ours", "sbx"):
            return None
        raise SystemExit(f"{name} is not installed here; TQC and others need sb3-contrib")
    kwargs = network(kind, net, spec["activation"])
    if kind in SPARSE:
        importlib.import_module("sb3_sparse")  # registers SparsePolicy
        policy, kwargs = "SparsePolicy", dict(kwargs, sparsity=spec["sparsity"])
    settings = dict(settings)
    if images and "buffer_size" in settings:
        settings["buffer_size"] = 2000  # 56 kB each
    if name == "PPO":
        settings["n_steps"] = spec["rollout"]
    env = environment(spec["env"])
    return made(policy, env, policy_kwargs=kwargs, seed=0, device="cpu", **settings)


class Meter:
    """Measures processor seconds in the functions that it wraps."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def around(self, function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def timed(*args: Any, **kwargs: Any) -> Any:
            start = time.process_time()
            try:
                return function(*args, **kwargs)
            finally:
                self.seconds += time.process_time() - start

        return timed


class Learner:
    """Trains a model and times its parts.

    Three clocks run: around ``learn()``, around ``train()``, and around the choice of an action:
    ``model.predict`` off policy, ``policy.forward`` on policy (``predict_all`` in SBX).
    """

    def __init__(self, spec: dict[str, Any], model: Any) -> None:
        self.model, self.train, self.act = model, Meter(), Meter()
        self.callback = None
        if spec["kind"] in SPARSE and spec["method"]:
            from sb3_sparse import SparsityCallback

            self.callback = SparsityCallback(spec["method"], update_interval=100, end=1.0)
        model.train = self.train.around(model.train)
        if hasattr(model, "replay_buffer"):
            model.predict = self.act.around(model.predict)
        elif spec["kind"] == "sbx":
            model.policy.predict_all = self.act.around(model.policy.predict_all)
        else:
            # Not on the policy itself: one that somebody has patched trains by its modules.
            cls = type(model.policy)
            own = {"forward": self.act.around(cls.forward), "__module__": cls.__module__}
            model.policy.__class__ = type(cls.__name__, (cls,), own)
        model.learn(getattr(model, "learning_starts", 0) + 20)  # SBX compiles here

    def learn(self, steps: int) -> dict[str, float]:
        """Measure processor seconds of at least so many steps, in whole rollouts on policy."""
        before = self.model.num_timesteps
        start, began = time.process_time(), time.perf_counter()
        self.train.seconds = self.act.seconds = 0.0
        self.model.learn(steps, callback=self.callback, reset_num_timesteps=False)
        return {
            "seconds": time.process_time() - start,
            "elapsed": time.perf_counter() - began,
            "steps": self.model.num_timesteps - before,
            "train": self.train.seconds,
            "act": self.act.seconds,
        }


def main() -> None:
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    import torch as th

    th.set_num_threads(1)
    learners: dict[str, Learner] = {}
    for line in sys.stdin:
        request = json.loads(line)
        answer: Any
        if "make" in request:
            learners.clear()
            gc.collect()  # a wrapped model is part of a cycle
            for key, spec in request["make"].items():
                model = build(spec)
                if model is not None:
                    learners[key] = Learner(spec, model)
            answer = list(learners)
        else:
            answer = learners[request["learn"]].learn(request["steps"])
        print(json.dumps(answer), file=answers, flush=True)


class Worker:
    """Starts the process and sends it requests."""

    def __init__(self, python: str) -> None:
        flags = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
        threads = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
        self.process = subprocess.Popen(
            [python, __file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, **threads, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"},
        )

    def ask(self, **request: Any) -> Any:
        """Send a request and return the answer.

        :raises SystemExit: if the process ends instead; stderr shows why
        """
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        with suppress(BrokenPipeError):  # it has ended: there is no answer either
            print(json.dumps(request), file=self.process.stdin, flush=True)
        line = self.process.stdout.readline()
        if not line:
            code = self.process.wait()
            raise SystemExit(f"end_to_end: a worker ended with code {code}; it says why above")
        return json.loads(line)

    def close(self) -> None:
        self.process.communicate()  # which closes its stdin, and so ends it


if __name__ == "__main__":
    main()
