"""Acting by one call of the kernels against SB3's way through the modules, for every policy."""

from __future__ import annotations

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.policies import BasePolicy
from support import ALGORITHMS, make
from torch import nn
from torch.nn import functional

from sb3_sparse import SparseActorCriticPolicy, SparseSACPolicy, SparsityCallback
from sb3_sparse.policies.fast_predict import FastPredict
from sb3_sparse.policies.training_mode import ModeSwitch

COMPUTE = ("masked", "sparse")
WIDE = dict(net_arch=[24, 24], sparsity=0.7)
ON_POLICY = ("PPO", "A2C", "TRPO")


CASES = [(name, compute) for name in ALGORITHMS for compute in COMPUTE]
BY_KERNELS = pytest.mark.parametrize(
    "model", [case for case in CASES if case[0] != "CrossQ"], indirect=True, ids="-".join
)
"""CrossQ's layers have batch normalisation between them."""


@pytest.fixture(params=CASES, ids="-".join)
def model(request):
    name, compute = request.param
    found = make(name, policy_kwargs=dict(WIDE, compute=compute))
    found.policy.set_training_mode(False)
    return found


def observations(model, count: int) -> np.ndarray:
    return np.stack([model.observation_space.sample() for _ in range(count)])


class ModuleByModule:
    """Makes a policy call its modules: somebody watches every one of them."""

    def __init__(self, policy: nn.Module) -> None:
        self.policy = policy

    def __enter__(self):
        leaves = [module for module in self.policy.modules() if not any(module.children())]
        self.handles = [leaf.register_forward_hook(lambda *_: None) for leaf in leaves]

    def __exit__(self, *_: object):
        for handle in self.handles:
            handle.remove()


def both_ways(model, act):
    """What ``act`` returns by the kernels and by SB3's code, and the random numbers left."""
    found = []
    for way in ("kernels", "modules"):
        th.manual_seed(3)
        with th.no_grad():
            if way == "kernels":
                result = act()
            else:
                with ModuleByModule(model.policy):
                    result = act()
        found.append((result, th.get_rng_state()))
    (ours, left), (theirs, right) = found
    assert th.equal(left, right)
    return ours, theirs


def same(ours, theirs) -> None:
    for one, other in zip(ours, theirs, strict=True):
        assert type(one) is type(other)
        assert one.dtype == other.dtype
        assert one.shape == other.shape
        np.testing.assert_allclose(one, other, rtol=2e-5, atol=2e-6)


@pytest.mark.parametrize("deterministic", [True, False])
@pytest.mark.parametrize("count", [None, 1, 5, 16, 20])
def test_predictions_are_those_of_sb3(model, count, deterministic):
    obs = observations(model, count or 1)
    obs = obs[0] if count is None else obs
    ours, theirs = both_ways(model, lambda: model.predict(obs, deterministic=deterministic)[:1])
    same(ours, theirs)
    th.manual_seed(3)
    with ModuleByModule(model.policy):
        same(ours, BasePolicy.predict(model.policy, obs, deterministic=deterministic)[:1])


@pytest.mark.parametrize("count", [1, 3, 16, 40])
def test_forward_gives_what_sb3s_gives(model, count):
    obs = th.as_tensor(observations(model, count))
    for deterministic in (False, True):
        ours, theirs = both_ways(model, lambda d=deterministic: model.policy(obs, d))
        same(*((r if isinstance(r, tuple) else (r,)) for r in (ours, theirs)))


@BY_KERNELS
def test_the_kernels_are_what_acts(model, monkeypatch):
    called = []

    def seen(self, x):
        called.append(type(self))
        return functional.linear(x, self.weight, self.bias)

    monkeypatch.setattr(nn.Linear, "forward", seen)
    with th.no_grad():
        model.predict(observations(model, 4))
        model.policy(th.as_tensor(observations(model, 4)))
    assert not called


@pytest.mark.parametrize("name", ON_POLICY)
@pytest.mark.parametrize("env", ["Pendulum-v1", "CartPole-v1"])
@pytest.mark.parametrize("share", [True, False])
def test_values_and_distributions_of_actor_critics(name, env, share):
    kwargs = dict(WIDE, share_features_extractor=share)
    model = make(name, env=env, policy_kwargs=kwargs)
    obs = th.as_tensor(observations(model, 5))
    policy = model.policy
    same(*([r] for r in both_ways(model, lambda: policy.predict_values(obs))))
    same(*both_ways(model, lambda: policy(obs)))

    def described():
        distribution = policy.get_distribution(obs)
        actions = distribution.sample()
        kinds = ("mean", "stddev") if env == "Pendulum-v1" else ("probs", "logits")
        inner = [getattr(distribution.distribution, kind) for kind in kinds]
        return [actions, distribution.log_prob(actions), distribution.entropy(), *inner]

    same(*both_ways(model, described))


@pytest.mark.parametrize("env", ["Pendulum-v1", "CartPole-v1"])
def test_the_log_probability_of_an_action_is_that_of_its_evaluation(env):
    model = make("PPO", env=env, policy_kwargs=WIDE)
    obs = th.as_tensor(observations(model, 7))
    with th.no_grad():
        actions, values, log_prob = model.policy(obs)
        again = model.policy.evaluate_actions(obs, actions)
    np.testing.assert_allclose(values, again[0], atol=1e-5)
    np.testing.assert_allclose(log_prob, again[1], atol=1e-5)


def test_the_distribution_that_acted_last_can_be_looked_at():
    model = make("PPO", policy_kwargs=WIDE)
    obs = th.as_tensor(observations(model, 3))
    with th.no_grad():
        actions, _, log_prob = model.policy(obs)
    last = model.policy.action_dist
    assert isinstance(last, DiagGaussianDistribution)
    np.testing.assert_allclose(last.log_prob(actions), log_prob.numpy(), atol=1e-5)
    assert last.distribution.mean.shape == actions.shape


@pytest.mark.parametrize("name", ["PPO", "SAC"])
def test_networks_that_hold_nan_are_told_as_by_sb3(name):
    model = make(name, policy_kwargs=WIDE)
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.fill_(th.nan)
    obs = observations(model, 1)
    with pytest.raises(ValueError, match="to satisfy the constraint Real"):
        model.predict(obs)
    with pytest.raises(ValueError, match="to satisfy the constraint Real"), th.no_grad():
        model.policy(th.as_tensor(obs))


@pytest.mark.parametrize("name", ALGORITHMS)
def test_observations_that_sb3_refuses_are_refused(name):
    model = make(name, policy_kwargs=WIDE)
    size = model.observation_space.shape[0]
    with pytest.raises(ValueError, match="Unexpected observation shape"):
        model.predict(np.zeros(size + 1, np.float32))
    with pytest.raises(ValueError, match="Unexpected observation shape"):
        model.predict(np.zeros((2, 3, size), np.float32))
    with pytest.raises(ValueError, match="mixing Gym API with SB3 VecEnv API"):
        model.predict((np.zeros(size, np.float32), {}))


@pytest.mark.parametrize("kind", [np.float64, np.float32, np.int64, list])
def test_observations_of_any_type_give_the_same(kind):
    model = make("SAC", policy_kwargs=WIDE)
    obs = np.array([1, 0, -2])
    given = obs.tolist() if kind is list else obs.astype(kind)
    given = np.array(given) if kind is list else given
    expected, _ = model.predict(obs.astype(np.float32), deterministic=True)
    acted, _ = model.predict(given, deterministic=True)
    np.testing.assert_allclose(acted, expected, rtol=1e-6)
    assert acted.shape == model.action_space.shape


@pytest.mark.parametrize(
    "kind", [spaces.MultiDiscrete([3, 2]), spaces.MultiBinary(3), spaces.Discrete(4)]
)
def test_other_actions_and_observations_of_an_actor_critic(kind):
    class Task(gym.Env):
        observation_space, action_space = spaces.Discrete(5), kind

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return 2, {}

        def step(self, action):
            return int(self.np_random.integers(5)), 0.0, False, False, {}

    model = make("PPO", env=Task(), policy_kwargs=WIDE)
    obs = th.tensor([0, 3, 2])
    same(*both_ways(model, lambda: model.policy(obs)))
    same(*both_ways(model, lambda: model.predict(np.array([0, 3, 2]))[:1]))


def test_what_a_subclass_of_the_users_own_overrides_is_called():
    class Cautious(SparseSACPolicy):
        def _predict(self, observation, deterministic=False):
            return 0.0 * super()._predict(observation, deterministic)

    from stable_baselines3 import SAC

    model = SAC(Cautious, "Pendulum-v1", policy_kwargs=dict(WIDE), buffer_size=10)
    assert model.predict(observations(model, 2))[0].tolist() == [[0.0], [0.0]]


def test_a_forward_that_was_patched_is_called():
    model = make("PPO", policy_kwargs=WIDE)
    obs = th.as_tensor(observations(model, 2))
    with th.no_grad():
        before = model.policy.predict_values(obs)
        model.policy.value_net.forward = lambda latent: th.full((len(latent), 1), 7.0)
        assert model.policy.predict_values(obs).tolist() == [[7.0], [7.0]]
        assert model.policy(obs)[1].tolist() == [[7.0], [7.0]]
        del model.policy.value_net.forward
        assert th.equal(model.policy.predict_values(obs), before)


@pytest.mark.parametrize("count", [2, 20])
def test_inactive_weights_do_not_act_whoever_wrote_them(model, count):
    obs = observations(model, count)
    expected, _ = model.predict(obs, deterministic=True)
    for layer in model.policy.sparse.layers:
        if not layer.is_sparse:
            with th.no_grad():
                layer.weight.add_(5.0 * (1 - layer.float_mask))
    np.testing.assert_allclose(model.predict(obs, deterministic=True)[0], expected, atol=1e-6)


@BY_KERNELS
def test_masks_that_move_are_followed(model):
    obs = th.as_tensor(observations(model, 2))
    with th.no_grad():
        model.policy(obs)
    model.learn(60, callback=SparsityCallback("set", update_interval=2))
    model.policy.set_training_mode(False)
    ours, theirs = both_ways(model, lambda: model.policy(obs))
    same(*((r if isinstance(r, tuple) else (r,)) for r in (ours, theirs)))


def test_copies_and_pickles_act_as_the_policy_does(model):
    obs = observations(model, 2)
    expected, _ = model.predict(obs, deterministic=True)
    for twin in (copy.deepcopy(model.policy), pickle.loads(pickle.dumps(model.policy))):
        assert isinstance(twin, FastPredict)
        np.testing.assert_array_equal(twin.predict(obs, deterministic=True)[0], expected)
        with th.no_grad():
            for parameter in twin.parameters():
                parameter.mul_(2.0)
        assert not np.array_equal(twin.predict(obs, deterministic=True)[0], expected) or (
            model.action_space.shape == ()
        )
        np.testing.assert_array_equal(model.predict(obs, deterministic=True)[0], expected)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_modes_are_those_that_sb3_sets(name):
    model = make(name, policy_kwargs=WIDE)
    stock = type(model)("MlpPolicy", model.get_env())
    for mode in (False, True, True, False, True):
        model.policy.set_training_mode(mode)
        stock.policy.set_training_mode(mode)
        ours = dict(model.policy.named_modules())
        for path, module in stock.policy.named_modules():
            if path in ours:
                assert ours[path].training is module.training, (path, mode)
    model.policy.train()
    model.predict(observations(model, 1))
    stock.predict(observations(model, 1))
    assert model.policy.training is stock.policy.training is False


@pytest.mark.parametrize("name", ["SAC", "DQN", "PPO"])
def test_a_part_that_was_put_into_training_mode_leaves_it_at_a_prediction(name):
    model = make(name, policy_kwargs=WIDE)
    model.predict(observations(model, 1))
    acting = {"SAC": "actor", "DQN": "q_net"}.get(name)
    part = list(model.policy.get_submodule(acting or "").modules())[-1]
    part.train()
    model.predict(observations(model, 1))
    assert not part.training


@pytest.mark.parametrize("name", ["SAC", "TD3"])
@pytest.mark.parametrize("low", [np.float32, np.float64, "wider"])
def test_actions_are_scaled_as_by_sb3(name, low):
    class Task(gym.Env):
        observation_space = spaces.Box(-1, 1, (3,), np.float32)
        action_space = spaces.Box(-2, 3, (2,), np.float64 if low is np.float64 else np.float32)

        def reset(self, *, seed=None, options=None):
            return self.observation_space.sample(), {}

    model = make(name, env=Task(), policy_kwargs=WIDE)
    policy = model.policy
    actions = np.random.default_rng(0).uniform(-1, 1, (4, 2)).astype(np.float32)
    policy.scale_action(actions)
    if low == "wider":
        policy.action_space.low = np.full(2, -20, np.float32)
    for ours, theirs in (
        (policy.scale_action, BasePolicy.scale_action),
        (policy.unscale_action, BasePolicy.unscale_action),
    ):
        for given in (actions, actions[0], actions.astype(np.float64)):
            expected = theirs(policy, given)
            np.testing.assert_array_equal(ours(given), expected)
            assert ours(given).dtype == expected.dtype
    obs = observations(model, 3)
    ours, theirs = both_ways(model, lambda: model.predict(obs, deterministic=True)[:1])
    same(ours, theirs)


def test_a_hook_on_the_part_that_acts_is_run():
    model = make("TD3", policy_kwargs=WIDE)
    obs, seen = observations(model, 1), []
    expected, _ = model.predict(obs)
    handle = model.actor.register_forward_hook(lambda *_: seen.append(1))
    np.testing.assert_allclose(model.predict(obs)[0], expected, atol=1e-6)
    assert seen == [1]
    handle.remove()
    model.predict(obs)
    assert seen == [1]


def test_modules_that_come_later_are_switched_too():
    net = nn.Sequential(nn.Linear(2, 2), nn.Dropout())
    modes = ModeSwitch()

    def set_mode(mode):
        net.train(mode)

    assert not modes.switch(net, set_mode, False)
    assert modes.switch(net, set_mode, True)
    assert all(module.training for module in net.modules())
    net.append(nn.Dropout())
    assert not modes.switch(net, set_mode, False)
    assert not any(module.training for module in net.modules())


def test_a_module_with_a_mode_of_its_own_keeps_it():
    class Frozen(nn.BatchNorm1d):
        def train(self, mode=True):
            return super().train(False)

    net = nn.Sequential(nn.Linear(2, 2), Frozen(2))
    modes = ModeSwitch()
    for mode in (True, False, True):
        assert not modes.switch(net, net.train, mode)
        assert net.training is net[0].training is mode
        assert net[1].training is False


@pytest.mark.parametrize("name", ["SAC", "DQN", "PPO"])
def test_an_extractor_is_called_once_whoever_watches(name):
    env = gym.make("TinyImages-v0", discrete=name == "DQN")
    model = make(name, env=env, policy_kwargs=WIDE)
    policy = {"SAC": "actor", "DQN": "q_net"}.get(name)
    part = getattr(model.policy, policy) if policy else model.policy
    called = []
    handles = [part.features_extractor.cnn[0].register_forward_hook(lambda *_: called.append(1))]
    model.predict(env.observation_space.sample())
    assert len(called) == 1
    last = [m for m in part.modules() if isinstance(m, nn.Linear)][-1]
    handles.append(last.register_forward_hook(lambda *_: None))
    model.predict(env.observation_space.sample())
    assert len(called) == 2


def acted(model, count=2):
    return model.predict(observations(model, count), deterministic=True)[0].tolist()


@pytest.mark.parametrize(
    "log_std",
    [
        th.tensor([-1.0], dtype=th.float64),
        th.tensor(-1.0),
        th.tensor([[-1.0]]),
    ],
    ids=["double", "scalar", "matrix"],
)
def test_a_log_std_of_another_type_or_shape_acts_as_in_sb3(log_std):
    model = make("PPO", policy_kwargs=WIDE)
    obs = th.as_tensor(observations(model, 3))
    model.policy.log_std = nn.Parameter(log_std)
    same(*both_ways(model, lambda: model.policy(obs)))


@pytest.mark.parametrize("name", ["PPO", "SAC"])
def test_the_default_device_of_torch_does_not_count(name):
    model = make(name, policy_kwargs=WIDE)
    obs = th.as_tensor(observations(model, 2))

    def act():
        with th.device("meta"):
            result = model.policy(obs)
        return result if isinstance(result, tuple) else (result,)

    assert all(result.is_cpu for result in both_ways(model, act)[0])


class OwnDistribution(SparseActorCriticPolicy):
    def get_distribution(self, obs):
        mean = super().get_distribution(obs).distribution.mean
        return self.action_dist.proba_distribution(0.25 + 0.0 * mean, self.log_std)


class OwnLatent(SparseActorCriticPolicy):
    def _get_action_dist_from_latent(self, latent_pi):
        mean = 0.25 + 0.0 * self.action_net(latent_pi)
        return self.action_dist.proba_distribution(mean, self.log_std)


@pytest.mark.parametrize("policy", [OwnDistribution, OwnLatent])
def test_a_distribution_of_the_users_own_acts(policy):
    from stable_baselines3 import PPO

    model = PPO(policy, "Pendulum-v1", policy_kwargs=WIDE)
    assert acted(model) == [[0.25], [0.25]]
    if policy is OwnLatent:
        obs = th.as_tensor(observations(model, 2))
        with th.no_grad():
            assert model.policy(obs, True)[0].tolist() == [[0.25], [0.25]]
            assert model.policy.get_distribution(obs).distribution.mean.tolist() == [[0.25]] * 2


@pytest.mark.parametrize("how", ["class", "instance"])
def test_parameters_of_a_distribution_of_the_users_own_act(how):
    model = make("SAC", policy_kwargs=WIDE)
    actor = model.actor
    kind = type(actor)
    model.predict(observations(model, 1))

    def params(self, obs):
        mean, log_std, rest = kind.get_action_dist_params(self, obs)
        return 0.0 * mean, log_std, rest

    if how == "class":
        actor.__class__ = type("Own", (kind,), {"get_action_dist_params": params})
        actor.use_kernels()
    else:
        actor.get_action_dist_params = params.__get__(actor)
    assert acted(model) == [[0.0], [0.0]]


def test_methods_that_predict_calls_may_be_patched():
    model = make("SAC", policy_kwargs=WIDE)
    obs = observations(model, 2)
    expected, _ = model.predict(0.5 * obs, deterministic=True)
    tensors = model.policy.obs_to_tensor
    model.policy.obs_to_tensor = lambda observation: tensors(0.5 * observation)
    np.testing.assert_allclose(model.predict(obs, deterministic=True)[0], expected, rtol=1e-5)
    model = make("PPO", policy_kwargs=WIDE)
    model.predict(observations(model, 1))
    model.policy.mlp_extractor.forward_actor = lambda features: th.zeros(len(features), 24)
    np.testing.assert_allclose(acted(model, 1), model.policy.action_net.bias[None].detach())


def test_what_is_done_to_the_flattening_of_observations_counts():
    class Nothing(nn.Flatten):
        def forward(self, x):
            return 0.0 * super().forward(x)

    model = make("SAC", policy_kwargs=WIDE)
    obs, seen = observations(model, 2), []
    model.predict(obs)
    extractor = model.actor.features_extractor
    handle = extractor.flatten.register_forward_hook(lambda *_: seen.append(1))
    model.predict(obs)
    assert seen == [1]
    handle.remove()
    extractor.flatten = Nothing()
    ours, theirs = both_ways(model, lambda: model.predict(obs, deterministic=True)[:1])
    same(ours, theirs)
    assert ours[0][0] == ours[0][1]


def test_inactive_weights_of_an_extractor_do_not_act_on_vectors_either():
    import gymnasium as gym

    class Task(gym.Env):
        observation_space = spaces.Box(0, 1, (1, 36, 36), np.float32)
        action_space = spaces.Box(-1, 1, (1,), np.float32)

        def reset(self, *, seed=None, options=None):
            return self.observation_space.sample(), {}

    kwargs = dict(WIDE, normalize_images=False, compute="masked")
    model = make("PPO", env=Task(), policy_kwargs=kwargs)
    obs = observations(model, 2)
    expected, _ = model.predict(obs, deterministic=True)
    for layer in model.policy.sparse.layers:
        with th.no_grad():
            layer.weight.add_(0.5 * (1 - layer.float_mask))
    np.testing.assert_allclose(model.predict(obs, deterministic=True)[0], expected, atol=1e-6)


@pytest.mark.parametrize("how", ["class", "instance"])
def test_a_part_that_switches_modes_in_its_own_way_is_asked_each_time(how):
    model = make("SAC", policy_kwargs=WIDE)
    kind, asked = type(model.actor), []

    def switch(self, mode):
        asked.append(mode)
        kind.set_training_mode(self, mode)

    if how == "class":
        model.actor.__class__ = type("Own", (kind,), {"set_training_mode": switch})
    else:
        model.actor.set_training_mode = switch.__get__(model.actor)
    for mode in (False, True, False):
        model.policy.set_training_mode(mode)
        assert asked.pop() is mode
