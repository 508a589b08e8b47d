"""What actions are sampled from: means and standard deviations, or logits."""

import numpy as np
import pytest
import torch as th
from export.test_outputs import WRITTEN, compiled_outputs, observations_of, outputs_of
from export.tools import VECTOR, Task
from gymnasium import spaces
from support import make

from sb3_sparse.errors import UnsupportedError
from sb3_sparse.export import export_policy
from sb3_sparse.export.numpy_policy import Policy


@pytest.mark.parametrize("algorithm", ["PPO", "SAC", "TQC", "CrossQ"])
@pytest.mark.parametrize("full_std", [True, False])
def test_state_dependent_exploration(algorithm, full_std, tmp_path):
    kwargs = dict(use_expln=True)
    if algorithm == "PPO":
        kwargs |= dict(full_std=full_std, squash_output=True)
    model = make(algorithm, use_sde=True, policy_kwargs=kwargs)
    owner = model.policy if algorithm == "PPO" else model.policy.actor
    th.manual_seed(0)
    owner.log_std.data.uniform_(-2, 1)
    for to in WRITTEN:
        assert export_policy(model, tmp_path / "policy", to, stochastic=True).parity.holds
    seen = observations_of(model)
    found = outputs_of(tmp_path / "policy", "numpy", seen)
    x = th.as_tensor(seen)
    latent = owner.mlp_extractor.policy_net(x) if algorithm == "PPO" else owner.latent_pi(x)
    log_std = owner.log_std.detach().numpy().astype(float)
    grows = 1 + np.log1p(np.maximum(log_std, 0) + 1e-6)
    factor = np.where(log_std > 0, grows, np.exp(log_std))
    variance = latent.detach().numpy().astype(float) ** 2 @ factor**2 + 1e-6
    np.testing.assert_allclose(found["std"], np.sqrt(variance), rtol=1e-4)
    low, high = model.action_space.low, model.action_space.high
    action = low + (np.tanh(found["mean"]) + 1) / 2 * (high - low)
    np.testing.assert_allclose(found["action"], action, atol=1e-5)


@pytest.mark.parametrize("algorithm", ["PPO", "SAC"])
def test_sampling_as_the_docs_say_gives_what_sb3_samples(algorithm, tmp_path):
    model = make(algorithm)
    export_policy(model, tmp_path / "policy", "numpy", stochastic=True)
    seen = observations_of(model)
    action, mean, std = Policy(tmp_path / "policy.npz")(seen)
    low, high = model.action_space.low, model.action_space.high
    th.manual_seed(3)
    expected, _ = model.predict(seen, deterministic=False)
    th.manual_seed(3)
    sampled = mean + std * th.randn(mean.shape).numpy()
    if algorithm == "PPO":
        sampled = np.clip(sampled, low, high)
    else:
        sampled = low + (np.tanh(sampled) + 1) / 2 * (high - low)
    np.testing.assert_allclose(sampled, expected, atol=1e-5)
    assert np.abs(sampled - action).max() > 0.1


@pytest.mark.parametrize("to", WRITTEN)
@pytest.mark.parametrize(
    "space",
    [spaces.Discrete(3), spaces.MultiDiscrete([3, 2, 4]), spaces.MultiBinary(3)],
    ids=lambda space: type(space).__name__,
)
def test_logits(space, to, tmp_path):
    model = make("PPO", Task(VECTOR, space))
    model.policy.action_net.weight.data.mul_(100)  # or all logits are nearly 0
    assert export_policy(model, tmp_path / "policy", to, stochastic=True).parity.holds
    seen = observations_of(model)
    if to == "c":
        logits = compiled_outputs(tmp_path / "policy", model, seen, stochastic=True)["logits"]
    else:
        logits = outputs_of(tmp_path / "policy", to, seen)["logits"]
    found = th.as_tensor(logits)
    distribution = model.policy.get_distribution(th.as_tensor(seen)).distribution
    if isinstance(space, spaces.MultiBinary):
        probs, expected = found.sigmoid(), distribution.probs
    else:
        parts = distribution if isinstance(distribution, list) else [distribution]
        expected = th.cat([part.probs for part in parts], dim=1)
        sizes = [part.probs.shape[1] for part in parts]
        probs = th.cat([part.softmax(dim=1) for part in found.split(sizes, dim=1)], dim=1)
    np.testing.assert_allclose(probs, expected.detach(), atol=1e-5)


@pytest.mark.parametrize("algorithm", ["DQN", "QRDQN", "TD3", "DDPG"])
def test_algorithms_without_a_distribution(algorithm, tmp_path):
    with pytest.raises(UnsupportedError, match="has no distribution of actions.*which is for PPO"):
        export_policy(make(algorithm), tmp_path / "policy", stochastic=True)
    assert list(tmp_path.iterdir()) == []
