"""A model that nobody holds any more is freed, with its replay buffer."""

from __future__ import annotations

import gc
import weakref

import pytest
from support import ALGORITHMS, make

from sb3_sparse import SparsityCallback


@pytest.mark.parametrize("method", ["static", "rigl"])
@pytest.mark.parametrize(
    ("algorithm", "env"), [*((name, None) for name in sorted(ALGORITHMS)), ("DQN", "TinyImages-v0")]
)
def test_a_trained_model_is_freed(algorithm, env, method):
    def train_and_forget():
        model = make(algorithm, env)
        options = {} if method == "static" else {"update_interval": 2}
        model.learn(48, callback=SparsityCallback(method, **options))
        return [weakref.ref(thing) for thing in (model, model.policy, model.get_env())]

    references = train_and_forget()
    gc.collect()
    assert [reference() for reference in references] == [None] * 3
