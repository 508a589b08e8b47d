from __future__ import annotations

import pytest
import torch as th
from image_support import impala, twins


@pytest.fixture(autouse=True, scope="package")
def every_batch_by_kernels():
    """Also few images go through the kernels, which are what is tested here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sb3_sparse.engine.images.pays", lambda *_: True)
        yield


@pytest.fixture(params=["kernels", "dense weights"])
def ways(request, monkeypatch):
    """What computes a batch of few images."""
    monkeypatch.setattr("sb3_sparse.engine.images.pays", lambda *_: request.param == "kernels")


@pytest.fixture(autouse=True)
def seeded():
    """Numbers that a test draws from torch are the same whenever it runs."""
    th.manual_seed(0)


@pytest.fixture
def both():
    """A part of the Impala ResNet, dense and sparse; modules 2 and 3 are residual blocks."""
    return twins(*impala())


@pytest.fixture
def x():
    """Images for it."""
    return th.randn(17, 2, 7, 9, generator=th.Generator().manual_seed(0))
