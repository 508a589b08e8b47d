"""How a process that trains computes."""

from __future__ import annotations

import pytest
import torch as th
from gymnasium import spaces

from sb3_sparse.zoo.speed import compute_fast

VECTOR = spaces.Box(-1.0, 1.0, (4,))
DENORMAL = 1e-40


@pytest.fixture
def _own_settings():
    threads = th.get_num_threads()
    yield
    th.set_num_threads(threads)
    th.set_flush_denormal(False)


@pytest.mark.usefixtures("_own_settings")
def test_denormal_results_become_zero():
    th.set_flush_denormal(False)
    small = th.tensor([1e-38])
    assert (small * 1e-2).item() == pytest.approx(DENORMAL, rel=1e-3)
    compute_fast(VECTOR)
    assert (small * 1e-2).item() == 0.0


@pytest.mark.usefixtures("_own_settings")
def test_vectors_get_one_thread(monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    th.set_num_threads(2)
    compute_fast(VECTOR)
    assert th.get_num_threads() == 1
