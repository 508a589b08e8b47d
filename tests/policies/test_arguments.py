"""Classes given by their dotted path."""

from __future__ import annotations

import pytest
import torch as th
from stable_baselines3 import SAC
from support import make

from sb3_sparse.errors import ConfigError


def test_dotted_paths_stand_for_classes_and_survive_saving(tmp_path):
    kwargs = dict(activation_fn="torch.nn.Tanh", optimizer_class="torch.optim.RMSprop")
    model = make("SAC", policy_kwargs=kwargs)
    for one in (model, _again(model, tmp_path)):
        assert any(isinstance(m, th.nn.Tanh) for m in one.policy.actor.modules())
        assert type(one.policy.actor.optimizer) is th.optim.RMSprop


def _again(model, tmp_path):
    model.save(tmp_path / "model")
    return SAC.load(tmp_path / "model")


@pytest.mark.parametrize("path", ["torch.nn.Tahn", "torc.nn.Tanh", "Tanh", ""])
def test_a_path_that_leads_nowhere_is_refused(path):
    with pytest.raises(ConfigError, match=r"activation_fn=.* cannot be imported"):
        make("SAC", policy_kwargs=dict(activation_fn=path))
