"""One method for all networks, or one for each."""

from __future__ import annotations

import pytest

from sb3_sparse.errors import ConfigError
from sb3_sparse.topology import Methods


def test_one_name_is_every_networks_method():
    methods = Methods.of("rigl")
    assert methods["actor"].name == methods["critic"].name == "rigl"
    assert methods.label == "rigl"
    assert methods.moving == ("rigl",)


def test_a_network_without_a_name_is_static():
    methods = Methods.of({"critic": "rigl"})
    assert methods["critic"].name == "rigl"
    assert methods["actor"].name == "static"
    assert methods.moving == ("rigl",)


def test_the_label_depends_neither_on_the_order_nor_on_static_networks_and_reads_back():
    one = Methods.of({"critic": "rigl", "actor": "set"})
    assert one.label == "actor=set, critic=rigl"
    for text in (one.label, "critic=rigl,actor=set", " actor = set,critic=rigl "):
        assert Methods.parse(text) == one
    mst = Methods.of({"actor": "static", "critic": "rigl"})
    assert mst.label == "critic=rigl"
    assert mst == Methods.of({"critic": "rigl"}) == Methods.parse("actor=static,critic=rigl")
    assert hash(mst) == hash(Methods.of({"critic": "rigl"}))
    assert mst != Methods.of({"actor": "rigl"})
    assert Methods.of({"actor": "static", "critic": "static"}) == Methods.of("static")
    assert Methods.parse("set") == Methods.of("set") != Methods.of("rigl")


def test_options_are_those_of_any_method():
    schedule = {"update_interval", "begin", "end", "update_on"}
    assert Methods.of({"actor": "static", "critic": "prune"}).options == schedule
    assert Methods.of({"actor": "prune", "critic": "set"}).options == schedule | {"drop_fraction"}
    assert Methods.of({"actor": "static"}).options == frozenset()


def test_methods_that_move_are_those_of_the_networks_in_order():
    assert Methods.of({"critic": "set", "actor": "prune"}).moving == ("prune", "set")
    assert Methods.of({"critic": "set", "actor": "static"}).moving == ("set",)
    assert Methods.of("static").moving == Methods.of({"critic": "static"}).moving == ()


@pytest.mark.parametrize(
    ("given", "sparsity", "start"),
    [
        ("rigl", 0.9, None),
        ("prune", 0.9, 0.0),
        ("granet", 0.9, 0.45),
        ("granet", {"actor": 0.8, "critic": 0.5}, {"actor": 0.4, "critic": 0.25}),
        ({"critic": "granet"}, 0.7, {"critic": 0.35}),
        ({"actor": "prune", "critic": "granet"}, 0.5, {"actor": 0.0, "critic": 0.25}),
        ({"critic": "granet"}, {"actor": 0.8, "critic": 0.5}, {"critic": 0.25}),
        ({"critic": "rigl", "actor": "static"}, 0.5, None),
        ("granet", "much", None),
        ("granet", None, None),
    ],
)
def test_what_training_usually_starts_with(given, sparsity, start):
    assert Methods.of(given).initial_sparsity(sparsity) == start


def test_whether_all_start_dense():
    assert Methods.of("prune").start_dense
    assert Methods.of({"actor": "prune", "critic": "prune"}).start_dense
    assert not Methods.of({"actor": "prune", "critic": "static"}).start_dense
    assert not Methods.of("granet").start_dense
    assert not Methods.of("rigl").start_dense


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, "name at least one"),
        ({"actor": "riggle"}, "unknown method 'riggle' .did you mean 'rigl'"),
        ({1: "rigl"}, "a method is given for 1"),
        ({"actor": None}, "unknown method None"),
        ("riggle", "unknown method 'riggle'"),
    ],
)
def test_what_is_no_method_is_named(given, message):
    with pytest.raises(ConfigError, match=message):
        Methods.of(given)


@pytest.mark.parametrize(
    "text", ["actor=", "=rigl", "actor=rigl,", "actor=rigl,set", "a=set,a=set"]
)
def test_a_text_of_another_form_is_refused_with_an_example(text):
    with pytest.raises(ConfigError, match="actor=set,critic=rigl; got"):
        Methods.parse(text)
