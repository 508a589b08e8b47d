from __future__ import annotations

import pytest
import torch as th


@pytest.fixture(autouse=True, scope="package")
def every_batch_by_kernels():
    """Also few images go through the kernels, which are what is tested here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sb3_sparse.engine.images.pays", lambda *_: True)
        yield


@pytest.fixture(autouse=True)
def seeded():
    """Numbers that a test draws from torch are the same whenever it runs."""
    th.manual_seed(0)
