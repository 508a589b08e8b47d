from __future__ import annotations

import pytest

from sb3_sparse.engine.native import library


@pytest.fixture(params=library.instruction_sets())
def instructions(request):
    before = library.in_use()
    library.use(request.param)
    yield request.param
    library.use(before)
