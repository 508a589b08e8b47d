"""What SB3's own tests demand of SB3's policies: observations, environments, settings."""

from __future__ import annotations

import gymnasium as gym
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor, NatureCNN
from stable_baselines3.common.vec_env import SubprocVecEnv, VecNormalize
from support import ALGORITHMS, DISCRETE, assert_masked, make

from sb3_sparse import SparseActorCriticPolicy, SparsityCallback
from sb3_sparse.errors import UnsupportedError
from sb3_sparse.policies.compiled import unwrapped

CALLBACK = dict(update_interval=4, drop_fraction=0.5)
CNN = dict(features_extractor_kwargs=dict(features_dim=16), net_arch=[16])
DICTS = dict(features_extractor_kwargs=dict(cnn_output_dim=16), net_arch=[16])
WITH_IMAGES = sorted(set(ALGORITHMS) - {"CrossQ"})  # which has no CNN policy in sb3-contrib
TWO_NETWORKS = ("SAC", "TD3", "DDPG", "TQC")


def environment(kind: str, name: str):
    return make_vec_env(
        f"Tiny{kind}-v0", env_kwargs=dict(discrete=name in (*DISCRETE, "PPO", "A2C", "TRPO"))
    )


@pytest.mark.parametrize("name", WITH_IMAGES)
@pytest.mark.parametrize(
    ("kind", "kwargs", "extractor"),
    [("Images", CNN, NatureCNN), ("Dicts", DICTS, CombinedExtractor)],
)
def test_images_and_dicts_get_the_extractor_of_sb3_and_train_sparsely(
    name, kind, kwargs, extractor
):
    model = make(name, environment(kind, name), policy_kwargs=dict(kwargs, sparsity=0.8))
    assert model.policy.features_extractor_class is extractor
    model.learn(48, callback=SparsityCallback("rigl", **CALLBACK))
    assert_masked(model)
    convs = [layer for layer in model.policy.sparse.layers if len(layer.shape) == 4]
    assert convs
    assert any(layer.nnz < layer.size for layer in convs)
    report = model.policy.sparsity_report()
    assert abs(report.sparsity() - 0.8) < len(report.layers) / sum(r.size for r in report.layers)


@pytest.mark.parametrize("name", TWO_NETWORKS)
def test_a_shared_extractor_belongs_to_the_actor_once_and_its_targets_follow(name):
    model = make(
        name,
        environment("Images", name),
        policy_kwargs=dict(CNN, sparsity=0.8, share_features_extractor=True),
    )
    actor, critic = model.policy.sparse.networks
    assert sum("features_extractor" in layer.name for layer in actor.layers) == 4
    assert not any("features_extractor" in layer.name for layer in critic.layers)
    model.learn(40, callback=SparsityCallback("set", **CALLBACK))
    assert actor.mask_updates > 0
    assert_masked(model)
    for layer in actor.layers:
        if "features_extractor" in layer.name:
            assert layer.targets


@pytest.mark.parametrize("shared", [True, False])
def test_ppo_finds_each_layer_of_an_extractor_with_several_names_once(shared):
    env = environment("Images", "PPO")
    model = make("PPO", env, policy_kwargs=dict(CNN, share_features_extractor=shared))
    names = [layer.name for layer in model.policy.sparse.layers]
    assert sum("pi_features_extractor" in name for name in names) == 4
    assert sum("vf_features_extractor" in name for name in names) == (0 if shared else 4)
    model.learn(64, callback=SparsityCallback("rigl", **CALLBACK))
    assert_masked(model)


@pytest.mark.parametrize("name", ["SAC", "TQC", "CrossQ", "PPO", "A2C", "TRPO"])
def test_gsde_trains_and_its_free_log_std_stays_dense(name):
    model = make(name, use_sde=True)
    names = [layer.name for layer in model.policy.sparse.layers]
    assert not any("log_std" in layer for layer in names)
    assert any(layer in ("actor.mu.0", "action_net") for layer in names)
    model.learn(48, callback=SparsityCallback("rigl", **CALLBACK))
    assert_masked(model)


@pytest.mark.parametrize("name", ["SAC", "TD3", "TQC", "CrossQ"])
def test_every_critic_has_its_own_mask_and_the_same_counts(name):
    model = make(name, policy_kwargs=dict(n_critics=3))
    layers = {layer.name: layer for layer in model.policy.sparse.layers}
    last = [i for i in range(12) if f"critic.qf0.{i}" in layers]
    for i in last:
        first, *others = (layers[f"critic.qf{k}.{i}"] for k in range(3))
        for other in others:
            assert other.nnz == first.nnz
            if first.nnz < first.size:
                assert (other.mask() != first.mask()).any()
    model.learn(40, callback=SparsityCallback("set", **CALLBACK))
    assert_masked(model)


@pytest.mark.parametrize("name", sorted(ALGORITHMS))
def test_several_environments(name):
    env_id = "CartPole-v1" if name in DISCRETE else "Pendulum-v1"
    model = make(name, make_vec_env(env_id, n_envs=3))
    model.learn(120, callback=SparsityCallback("rigl", **CALLBACK))
    assert_masked(model)


@pytest.mark.parametrize("storage", ["sparse"], indirect=True)  # environments know of none
def test_subprocess_environments_and_vec_normalize():
    env = VecNormalize(make_vec_env("Pendulum-v1", n_envs=2, vec_env_cls=SubprocVecEnv))
    model = make("PPO", env)
    model.learn(128, callback=SparsityCallback("rigl", **CALLBACK))
    assert_masked(model)
    env.close()


@pytest.mark.parametrize("name", ["SAC", "TD3", "TQC", "DQN", "QRDQN"])
def test_as_many_gradient_steps_as_environment_steps_and_whole_episodes(name):
    env_id = "CartPole-v1" if name in DISCRETE else "Pendulum-v1"
    env = gym.make(env_id, max_episode_steps=30)
    model = make(name, env, train_freq=(1, "episode"), gradient_steps=-1)
    model.learn(90, callback=SparsityCallback("rigl", **CALLBACK))
    assert all(network.clock >= 30 for network in model.policy.sparse.networks[-1:])
    assert_masked(model)


@pytest.mark.parametrize("name", sorted(ALGORITHMS))
def test_set_env_and_predict(name):
    model = make(name)
    model.learn(48, callback=SparsityCallback("set", **CALLBACK))
    env_id = "CartPole-v1" if name in DISCRETE else "Pendulum-v1"
    model.set_env(make_vec_env(env_id, n_envs=model.n_envs))
    model.learn(48, callback=SparsityCallback("set", **CALLBACK))
    assert_masked(model)
    observation = model.env.reset()
    action, _ = model.predict(observation, deterministic=True)
    assert model.action_space.contains(action[0])


@pytest.mark.parametrize(
    ("policy", "kind", "extractor"),
    [
        ("SparseMlpPolicy", "Images", FlattenExtractor),
        ("SparseCnnPolicy", "Images", NatureCNN),
        ("SparseMultiInputPolicy", "Dicts", CombinedExtractor),
    ],
)
@pytest.mark.parametrize("name", WITH_IMAGES)
def test_policy_names_that_sb3_users_expect(name, policy, kind, extractor):
    model = make(name, environment(kind, name), policy=policy, policy_kwargs=dict(net_arch=[8]))
    assert model.policy.features_extractor_class is extractor


@pytest.mark.parametrize("name", ["RecurrentPPO", "MaskablePPO", "ARS"])
def test_algorithms_that_cannot_be_sparse_say_so(name):
    import sb3_contrib

    algorithm = getattr(sb3_contrib, name)
    with pytest.raises(UnsupportedError, match=rf"{name} has no sparse policy.*SAC"):
        algorithm("SparsePolicy", "CartPole-v1", policy_kwargs=dict(sparsity=0.9))


def test_observations_that_sb3_cannot_preprocess_are_rejected():
    from sb3_sparse import SparseSACPolicy

    odd = spaces.Tuple((spaces.Discrete(2), spaces.Discrete(2)))
    with pytest.raises(UnsupportedError, match=r"Tuple.*Box.*Dict"):
        SparseSACPolicy(odd, spaces.Box(-1, 1, (1,)), lambda _: 1e-3, sparsity=0.5)


@pytest.mark.parametrize(
    ("algorithm", "message"),
    [("RecurrentPPO", "RecurrentPPO has no sparse policy"), ("ARS", "such as ARS, have no sparse")],
)
def test_an_algorithm_without_a_sparse_policy_says_so_for_the_class_too(algorithm, message):
    contrib = pytest.importorskip("sb3_contrib")
    with pytest.raises(UnsupportedError, match=message):
        getattr(contrib, algorithm)(
            SparseActorCriticPolicy, "Pendulum-v1", policy_kwargs=dict(sparsity=0.9)
        )


@pytest.mark.parametrize("name", ["SAC", "PPO", "DQN"])
def test_the_callback_works_on_a_compiled_policy(name):
    model = make(name)
    model.policy = th.compile(model.policy, backend="eager")
    model.learn(48, callback=SparsityCallback("set", update_interval=2))
    assert model.policy.sparse.networks[0].mask_updates
    model.policy = unwrapped(model.policy)
    assert_masked(model)
