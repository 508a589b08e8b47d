"""Cases of end_to_end.py: algorithm, network and environment."""

from __future__ import annotations

from learner import ALGORITHMS, IMAGES, NOISE, is_atari

CARTPOLE = "CartPole-v1"
PONG = "PongNoFrameskip-v4"
CASES: dict[str, list[float]] = {
    "sac-256": [0.0, 0.9, 0.95],
    "sac-1024": [0.9, 0.95],
    "td3-256": [0.0, 0.9],
    "tqc-256": [0.0, 0.9, 0.95],
    "qrdqn-256": [0.0, 0.9, 0.95],
    "crossq-256": [0.0, 0.9, 0.95],
    "crossq-1024": [0.9],
    "dqn-512": [0.0, 0.9],
    "dqn4-512": [0.9],
    "ppo-64": [0.0, 0.9],
    "ppo-256": [0.9],
    f"ppo-64@{CARTPOLE}": [0.9],
    f"ppo-256@{CARTPOLE}": [0.9],
    "a2c-64": [0.0, 0.9],
    "dqn4-nature": [0.0, 0.9, 0.95],
    "dqn4-impala": [0.0, 0.9, 0.95],
    f"dqn4-nature@{PONG}": [0.9, 0.95],
}
"""Sparsities of each case."""


def parsed(case: str) -> tuple[str, str, str]:
    """Split a case into algorithm, network and environment.

    :raises ValueError: if it is not a case
    """
    name, _, env = case.partition("@")
    algo, _, net = name.partition("-")
    if algo not in ALGORITHMS:
        raise ValueError(f"case {case!r}: the algorithm is one of {', '.join(ALGORITHMS)}")
    discrete = "dqn" in algo
    if net in IMAGES:
        if env and not is_atari(env):
            raise ValueError(
                f"case {case!r}: {net} takes images: of noise, so name no environment, or of an "
                f"Atari game, such as {PONG}"
            )
        if not discrete and ALGORITHMS[algo][0] not in ("PPO", "A2C"):
            raise ValueError(f"case {case!r}: image networks go with DQN, QRDQN, PPO and A2C")
        return algo, net, env or NOISE
    if not net.isdecimal() or int(net) == 0:
        nets = ", ".join(sorted(IMAGES))
        raise ValueError(f"case {case!r}: the network is a width, such as 256, or one of {nets}")
    return algo, net, env or (CARTPOLE if discrete else "HalfCheetah-v5")
