"""What programs do not cover trains by stock ``train()``, to the bit, and the log says once why."""

from __future__ import annotations

import copy

import pytest
import torch as th
from algorithms_support import STOCK, assert_alike, learn, make, reason_of
from stable_baselines3.common.distributions import (
    DiagGaussianDistribution,
    SquashedDiagGaussianDistribution,
)
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.torch_layers import FlattenExtractor
from support import TinyDicts, TinyImages
from torch import nn

import sb3_sparse
from sb3_sparse.engine.native import library
from sb3_sparse.fused.errors import NotCovered
from sb3_sparse.policies.actor_critic import SparseActorCriticPolicy
from sb3_sparse.policies.base import BaseSparsePolicy
from sb3_sparse.policies.compiled import unwrapped
from sb3_sparse.policies.contrib import renorms_of
from sb3_sparse.policies.dqn import SparseDQNPolicy
from sb3_sparse.policies.sac import SparseSACPolicy


class Ear(Logger):
    """Hears what SB3 shows its users at ``verbose=1``."""

    def __init__(self) -> None:
        super().__init__(folder=None, output_formats=[])
        self.heard: list[str] = []

    def info(self, *args) -> None:
        self.heard += map(str, args)


def assert_falls_back(name, why, change=lambda model: None, env=lambda: None, **kwargs):
    """Two rounds of training, since the log shall not say it again in the second."""
    models = []
    for which in (sb3_sparse, STOCK):
        arguments = {key: dict(v) if isinstance(v, dict) else v for key, v in kwargs.items()}
        model = make(which, name, env(), **arguments)
        change(model)
        model.set_logger(Ear())
        for _ in range(2):
            learn(model, steps=25)
        models.append(model)
    ours, stock = models
    assert why in reason_of(ours)
    said = f"Gradient steps are Stable-Baselines3's own: {reason_of(ours)}"
    assert ours.logger.heard == [said] * isinstance(unwrapped(ours.policy), BaseSparsePolicy)
    assert_alike(ours, stock, exact=True)


@pytest.mark.parametrize("env", [TinyImages, TinyDicts])
@pytest.mark.parametrize("name", ["DQN", "A2C"])
def test_images_and_dict_observations(name, env):
    why = "CombinedExtractor" if env is TinyDicts else "NatureCNN"
    kwargs = dict(batch_size=4) if name == "DQN" else {}
    assert_falls_back(name, why, env=env, **kwargs)


@pytest.mark.parametrize("name", ["SAC", "PPO", "A2C"])
def test_exploration_that_depends_on_the_state(name):
    assert_falls_back(name, "gSDE", use_sde=True)


class Halved(FlattenExtractor):
    def forward(self, obs):
        return super().forward(obs) * 0.5


@pytest.mark.parametrize("name", ["TD3", "PPO"])
def test_an_extractor_of_the_users_own(name):
    kwargs = dict(features_extractor_class=Halved)
    assert_falls_back(name, "features extractor Halved", policy_kwargs=kwargs)


@pytest.mark.parametrize("activation", [nn.Softplus, nn.Mish, nn.Hardswish])
@pytest.mark.parametrize("name", ["SAC", "PPO"])
def test_other_activations(name, activation):
    why = f"the activation {activation.__name__}"
    assert_falls_back(name, why, policy_kwargs=dict(activation_fn=activation))


def dropout():
    return nn.Dropout(0.2)


def test_layers_that_are_no_activations():
    kwargs = dict(activation_fn=dropout)
    assert_falls_back("DQN", "a network with Dropout", policy_kwargs=kwargs)


class Normalised(SparseDQNPolicy):
    def make_q_net(self):
        found = super().make_q_net()
        found.q_net.insert(1, nn.LayerNorm(24))
        return found


def test_normalisation_layers():
    assert_falls_back("DQN", "LayerNorm", policy=Normalised)


def test_a_dense_policy_of_stock():
    assert_falls_back("SAC", "the policy, SACPolicy, is not sparse", policy="MlpPolicy")


def double(module, args, result):
    return result * 2


def hook_module(model):
    model.policy.critic.register_forward_hook(lambda module, args, result: None)


def hook_layer(model):
    model.policy.actor.latent_pi[0].register_forward_hook(double)


def hook_backward(model):
    layer = model.policy.critic.qf0[2]
    layer.register_full_backward_hook(lambda module, into, out: (into[0] * 2,))


def hook_parameter(model):
    model.policy.critic.qf0[2].bias.register_hook(lambda grad: grad * 0.5)


def halve(grad):
    grad.mul_(0.5)


def hook_accumulated(model):
    weight = model.policy.actor.mu.bias
    weight.register_post_accumulate_grad_hook(lambda parameter: halve(parameter.grad))


def hook_entropy(model):
    model.log_ent_coef.register_hook(lambda grad: grad * 0.5)


def freeze(model):
    for parameter in model.policy.critic.qf0[0].parameters():
        parameter.requires_grad_(False)


def freeze_bias(model):
    model.policy.actor.mu.bias.requires_grad_(False)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (hook_module, "hooks on modules"),
        (hook_layer, "hooks on modules"),
        (hook_backward, "hooks on modules"),
        (hook_parameter, "hooks on parameters"),
        (hook_accumulated, "hooks on parameters"),
        (hook_entropy, "hooks on parameters"),
        (freeze, "frozen"),
        (freeze_bias, "frozen"),
    ],
)
def test_hooks_and_frozen_parameters(change, why):
    assert_falls_back("SAC", why, change)


def test_hooks_on_all_modules():
    handle = nn.modules.module.register_module_forward_hook(lambda module, args, result: None)
    try:
        assert_falls_back("PPO", "hooks on modules")
    finally:
        handle.remove()


class Doubting(SparseActorCriticPolicy):
    def evaluate_actions(self, obs, actions):
        values, log_prob, entropy = super().evaluate_actions(obs, actions)
        return values * 0.5, log_prob, entropy


class Wide(DiagGaussianDistribution):
    def log_prob(self, actions):
        return super().log_prob(actions) * 0.5


class OwnDistribution(SparseActorCriticPolicy):
    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.action_dist = Wide(3)


class OwnActor(SparseSACPolicy):
    def make_actor(self, *args, **kwargs):
        actor = super().make_actor(*args, **kwargs)

        class Scaled(type(actor)):
            def get_action_dist_params(self, obs):
                mean, log_std, more = super().get_action_dist_params(obs)
                return mean * 0.5, log_std, more

        actor.__class__ = Scaled
        return actor


@pytest.mark.parametrize("policy", [Doubting, OwnDistribution])
@pytest.mark.parametrize("name", ["PPO", "A2C"])
def test_policies_of_the_users_own_of_rollouts(name, policy):
    why = "the distribution Wide" if policy is OwnDistribution else "methods of its own"
    assert_falls_back(name, why, policy=policy)


def test_policies_of_the_users_own_of_replay():
    assert_falls_back("SAC", "of its own", policy=OwnActor)


def test_a_distribution_of_the_users_own():
    class Steep(SquashedDiagGaussianDistribution):
        def log_prob(self, *args):
            return super().log_prob(*args) * 0.5

    def replace(model):
        model.policy.actor.action_dist = Steep(3)

    assert_falls_back("SAC", "the distribution Steep", replace)
    model = learn(make(sb3_sparse, "SAC"))
    replace(model)
    learn(model, steps=5)
    assert model._trains().reason == "the distribution Steep"


def test_a_method_that_somebody_has_put_over_one():
    def patch(model):
        forward = model.policy.critic.forward
        model.policy.critic.forward = lambda *args: tuple(q * 0.5 for q in forward(*args))

    assert_falls_back("TD3", "critic has methods of its own", patch)


def test_parts_that_torch_has_compiled():
    def compile_actor(model):
        model.policy.actor = model.actor = th.compile(model.policy.actor, backend="eager")

    def compile_policy(model):
        model.policy = th.compile(model.policy, backend="eager")

    assert_falls_back("SAC", "", compile_actor)
    assert_falls_back("A2C", "", compile_policy)


def test_targets_that_are_copies():
    assert_falls_back("SAC", "targets that are copies", tau=1.0)


def test_anomaly_detection():
    with th.autograd.detect_anomaly(check_nan=False):
        assert_falls_back("SAC", "anomaly detection")


def test_no_kernels(monkeypatch, tmp_path):
    monkeypatch.setattr(library, "PATH", tmp_path / "kernels.so")
    library.library.cache_clear()
    try:
        for name in ("SAC", "A2C"):
            assert_falls_back(name, "there are no kernels: ")
    finally:
        library.library.cache_clear()


def test_what_comes_and_goes_is_followed():
    def train(library):
        model = learn(make(library, "SAC"))
        handle = model.policy.critic.register_forward_hook(lambda module, args, result: None)
        learn(model, steps=5)
        reasons.append(model._trains().reason if library is sb3_sparse else None)
        handle.remove()
        return learn(model, steps=5)

    reasons = []
    ours = train(sb3_sparse)
    assert_alike(ours, train(STOCK))
    assert reasons == ["hooks on modules", None]
    assert ours._trains().reason is None


@pytest.mark.parametrize(
    ("name", "setting", "values"),
    [("TQC", "top_quantiles_to_drop_per_net", (0, 3)), ("QRDQN", "max_grad_norm", (0.01, None))],
)
def test_settings_that_change_the_program_are_followed(name, setting, values):
    def train(library):
        model = learn(make(library, name))
        for value in values:
            setattr(model, setting, value)
            learn(model, steps=5)
        return model

    ours = train(sb3_sparse)
    assert ours.why_not_fused() is None
    assert_alike(ours, train(STOCK))


def test_targets_without_any_quantile_are_stock_training():
    kwargs = dict(policy_kwargs=dict(n_quantiles=6), top_quantiles_to_drop_per_net=6)
    ours, stock = (learn(make(library, "TQC", **kwargs)) for library in (sb3_sparse, STOCK))
    assert reason_of(ours) == "a target of 0 among 12 quantiles"
    assert_alike(ours, stock)


def freeze(model):
    model.ent_coef_optimizer = None
    if not isinstance(model, STOCK.CrossQ):  # which keeps the learned one
        model.ent_coef_tensor = th.tensor(0.1)


def forget(model):
    freeze(model)
    model.log_ent_coef, model.ent_coef_tensor = None, th.tensor(0.2)


def replace(model):
    model.log_ent_coef = th.log(th.tensor([0.5])).requires_grad_()


@pytest.mark.parametrize("change", [freeze, forget, replace])
@pytest.mark.parametrize("name", ["SAC", "TQC", "CrossQ"])
def test_a_changed_entropy_coefficient_is_followed(name, change):
    def train(library):
        model = learn(make(library, name))
        change(model)
        return learn(model, steps=5)

    ours = train(sb3_sparse)
    assert ours.why_not_fused() is None
    assert_alike(ours, train(STOCK))


def test_settings_of_norms_are_followed():
    def train(library):
        model = learn(make(library, "CrossQ"))
        for name, number in (("momentum", 0.5), ("eps", 0.1), ("warmup_steps", 0), ("rmax", 1.5)):
            for norm in renorms_of(model.policy):
                setattr(norm, name, number)
            learn(model, steps=5)
        return model

    ours = train(sb3_sparse)
    assert ours.why_not_fused() is None
    assert len(ours._trains()._machines) == 1  # none of earlier settings keeps its memory
    assert_alike(ours, train(STOCK))


def test_norms_without_scale_are_stock_training():
    def train(library):
        model = make(library, "CrossQ")
        for norm in renorms_of(model.policy):
            norm.affine = False
        return learn(model)

    ours = train(sb3_sparse)
    assert reason_of(ours) == "a BatchRenorm that is not affine"
    assert_alike(ours, train(STOCK))


@pytest.mark.parametrize("name", ["SAC", "A2C"])
def test_settings_of_activations_are_followed(name):
    def train(library):
        model = learn(make(library, name, policy_kwargs=dict(activation_fn=nn.LeakyReLU)))
        for module in model.policy.modules():
            if isinstance(module, nn.LeakyReLU):
                module.negative_slope = 0.5
        return learn(model, steps=10)

    assert_alike(train(sb3_sparse), train(STOCK))


@pytest.mark.parametrize(
    ("name", "part"),
    [("DQN", "q_net_target"), ("SAC", "critic_target"), ("TD3", "actor_target")],
)
def test_a_network_of_the_model_that_is_none_of_its_policy(name, part):
    def replace(model):
        twin = copy.deepcopy(getattr(model, part))
        with th.no_grad():
            for parameter in twin.parameters():
                parameter.mul_(3)
        setattr(model, part, twin)

    assert_falls_back(name, f"{part} is another module", replace)


@pytest.mark.parametrize("name", ["SAC", "PPO"])
def test_gradients_of_the_user_s_own_do_not_pile_up(name):
    model = learn(make(sb3_sparse, name))
    for parameter in model.policy.parameters():
        parameter.grad = th.ones_like(parameter)
    learn(model)
    moved = [p for o in model.policy.sparse.optimizers for g in o.param_groups for p in g["params"]]
    assert model.why_not_fused() is None
    assert all(parameter.grad is None for parameter in moved)


def test_the_error_of_an_algorithm_without_a_way_back_says_what_is_covered():
    model = make(sb3_sparse, "DQN", policy_kwargs=dict(activation_fn=nn.Softplus))
    with pytest.raises(NotCovered, match=r"cannot be fused: the activation Softplus\. The page on"):
        model._next_machine()
