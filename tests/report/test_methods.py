"""Every method with a name has a look of its own."""

from __future__ import annotations

from sb3_sparse.report.methods import LOOKS, NAMES
from sb3_sparse.topology import method_names


def test_what_is_named_is_drawn_and_no_two_alike():
    assert set(LOOKS) == set(NAMES)
    assert {"static", "set", "rigl", "prune", "granet"} <= set(NAMES) & set(method_names())
    assert len({look.color for look in LOOKS.values()}) == len(LOOKS)
    assert len({(look.marker, str(look.line)) for look in LOOKS.values()}) == len(LOOKS)
