"""Sparse policies of sb3-contrib: TQC, QR-DQN and CrossQ."""

from __future__ import annotations

from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor, NatureCNN

from sb3_sparse.errors import MissingExtra
from sb3_sparse.policies.critics import PassesGradientsOn, SparseCriticsMixin
from sb3_sparse.policies.mixin import SparsePolicyMixin, with_extractor
from sb3_sparse.policies.parts import SparsePart
from sb3_sparse.policies.sac import GAUSSIAN_ACTOR, TWIN_CRITIC
from sb3_sparse.policies.spec import NetworkSpec

try:
    from sb3_contrib.crossq.policies import Actor as CrossQActor
    from sb3_contrib.crossq.policies import CrossQCritic, CrossQPolicy
    from sb3_contrib.qrdqn.policies import QRDQNPolicy, QuantileNetwork
    from sb3_contrib.tqc.policies import Actor as TQCActor
    from sb3_contrib.tqc.policies import Critic, TQCPolicy
except ImportError as error:
    raise MissingExtra("a sparse policy of TQC, QRDQN, CrossQ or TRPO", "contrib") from error


class SparseTQCActor(SparsePart, TQCActor):
    """Actor of TQC."""


class SparseTQCCritic(PassesGradientsOn, Critic):
    """Quantile critic of TQC."""


class SparseTQCPolicy(SparseCriticsMixin, TQCPolicy):
    """Sparse actor and quantile critics for TQC."""

    actor_class = SparseTQCActor
    critic_class = SparseTQCCritic
    networks = {"actor": GAUSSIAN_ACTOR, "critic": TWIN_CRITIC}


SparseTQCMlpPolicy = with_extractor(SparseTQCPolicy, "Mlp", FlattenExtractor)
SparseTQCCnnPolicy = with_extractor(SparseTQCPolicy, "Cnn", NatureCNN)
SparseTQCMultiInputPolicy = with_extractor(SparseTQCPolicy, "MultiInput", CombinedExtractor)


class SparseQuantileNetwork(SparsePart, QuantileNetwork):
    """Quantile network of QR-DQN."""


class SparseQRDQNPolicy(SparsePolicyMixin, QRDQNPolicy):
    """Sparse quantile network for QR-DQN."""

    networks = {
        "quantile_net": NetworkSpec(
            roots=("quantile_net",),
            trunks=("quantile_net.quantile_net",),
            heads=("quantile_net.quantile_net",),
            target="quantile_net_target",
        )
    }

    def make_quantile_net(self) -> SparseQuantileNetwork:
        """As in sb3-contrib, of our class."""
        kwargs = self._update_features_extractor(self.net_args, features_extractor=None)
        return SparseQuantileNetwork(**kwargs).to(self.device)


SparseQRDQNMlpPolicy = with_extractor(SparseQRDQNPolicy, "Mlp", FlattenExtractor)
SparseQRDQNCnnPolicy = with_extractor(SparseQRDQNPolicy, "Cnn", NatureCNN)
SparseQRDQNMultiInputPolicy = with_extractor(SparseQRDQNPolicy, "MultiInput", CombinedExtractor)


class SparseCrossQActor(SparsePart, CrossQActor):
    """Actor of CrossQ."""


class SparseCrossQCritic(PassesGradientsOn, CrossQCritic):
    """Critic of CrossQ."""


class SparseCrossQPolicy(SparseCriticsMixin, CrossQPolicy):
    """Sparse actor and critics for CrossQ, which has no target network."""

    actor_class = SparseCrossQActor
    critic_class = SparseCrossQCritic
    networks = {
        "actor": GAUSSIAN_ACTOR,
        "critic": NetworkSpec(
            roots=("critic",), trunks=("critic.qf*",), heads=("critic.qf*",), owner="critic"
        ),
    }


SparseCrossQMlpPolicy = with_extractor(SparseCrossQPolicy, "Mlp", FlattenExtractor)
