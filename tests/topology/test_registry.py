"""Methods by name."""

from __future__ import annotations

import pytest

from sb3_sparse.errors import ConfigError
from sb3_sparse.topology import DropGrow, TopologyMethod, method_named, method_names, register
from sb3_sparse.topology import registry as registry_module
from sb3_sparse.topology.base import NOTHING

BUILT_IN = ("granet", "prune", "rigl", "set", "static")


@pytest.fixture(autouse=True)
def _restored_registry(monkeypatch):
    """What a test registers is forgotten after it."""
    monkeypatch.setattr(registry_module, "_METHODS", dict(registry_module._METHODS))


def method_class(class_name: str, method_name: str, module: str = "somewhere") -> type:
    """A method that never moves anything, made as if in a module of its own."""
    body = {
        "__module__": module,
        "__qualname__": class_name,
        "name": method_name,
        "exchange": lambda self, layer, update, *, dense_grad: NOTHING,
    }
    return type(class_name, (TopologyMethod,), body)


def test_the_methods_of_the_paper_are_known():
    assert set(method_names()) >= set(BUILT_IN)


def test_names_are_sorted_and_unique():
    register(method_class("Zebra", "a-zebra"))
    register(method_class("Ant", "z-ant"))
    names = method_names()
    assert names == sorted(set(names))
    assert {"a-zebra", "z-ant"} <= set(names)


@pytest.mark.parametrize("name", BUILT_IN)
def test_a_method_is_found_by_its_name(name):
    method = method_named(name)
    assert isinstance(method, TopologyMethod)
    assert method.name == name


@pytest.mark.parametrize("name", ["magic", "RigL", "", None, 3, ["set"]])
def test_unknown_method_is_an_error_that_lists_the_allowed(name):
    with pytest.raises(ConfigError) as caught:
        method_named(name)
    message = str(caught.value)
    assert repr(name) in message
    assert ", ".join(method_names()) in message
    assert "@register" in message


def test_the_error_lists_methods_that_a_user_registered():
    register(method_class("Mine", "mine"))
    with pytest.raises(ConfigError, match="mine, .*prune"):
        method_named("magic")


def test_register_returns_the_class_and_makes_it_known():
    cls = method_class("Mine", "mine")
    assert register(cls) is cls
    assert type(method_named("mine")) is cls


def test_a_name_that_is_taken_is_an_error_that_names_the_owner():
    with pytest.raises(ConfigError, match="'set' is taken by .*SET; choose another"):
        register(method_class("Mine", "set"))
    assert type(method_named("set")).__module__ == "sb3_sparse.topology.set"


def test_a_subclass_without_a_name_of_its_own_does_not_replace_its_parent():
    parent = type(method_named("rigl"))
    with pytest.raises(ConfigError, match="'rigl' is taken"):
        register(type("BetterRigL", (parent,), {}))
    assert type(method_named("rigl")) is parent


def test_a_class_of_the_same_name_in_another_module_does_not_replace_a_method():
    with pytest.raises(ConfigError, match="'set' is taken"):
        register(method_class("SET", "set", module="somebody.elses"))


def test_registering_again_after_a_reload_replaces_the_class():
    first = register(method_class("Mine", "mine"))
    second = register(method_class("Mine", "mine"))
    assert first is not second
    assert type(method_named("mine")) is second
    assert method_names().count("mine") == 1


@pytest.mark.parametrize("name", ["", None, 7])
def test_a_class_without_a_usable_name_is_an_error_that_says_how_to_name_it(name):
    with pytest.raises(ConfigError, match="Nameless needs a class attribute `name`"):
        register(method_class("Nameless", name))


def test_a_class_that_never_set_a_name_is_an_error():
    class Nameless(DropGrow):
        def scores(self, layer, update, candidates, *, dense_grad):
            return candidates

    with pytest.raises(ConfigError, match="needs a class attribute `name`"):
        register(Nameless)


# What the callback and the engine read off a method (SEMANTICS.md, sections 5 and 6).
@pytest.mark.parametrize(
    ("name", "needs_gradient", "grows", "reaches_final", "default_begin", "takes_drop_fraction"),
    [
        ("static", False, False, False, 0.0, False),
        ("set", False, True, False, 0.0, True),
        ("rigl", True, True, False, 0.0, True),
        ("prune", False, False, True, 0.2, False),
        ("granet", True, True, True, 0.0, True),
    ],
)
def test_what_each_method_says_of_itself(
    name, needs_gradient, grows, reaches_final, default_begin, takes_drop_fraction
):
    method = method_named(name)
    assert method.needs_gradient is needs_gradient
    assert method.grows is grows
    assert method.reaches_final is reaches_final
    assert method.default_begin == default_begin
    assert ("drop_fraction" in method.options) is takes_drop_fraction
