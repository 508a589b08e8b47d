from __future__ import annotations

import pytest
import support


@pytest.fixture(autouse=True, params=["masked", "sparse"])
def storage(request, monkeypatch):
    """Every conformance test runs over both storages."""
    monkeypatch.setitem(support.storage, "compute", request.param)
    return request.param
