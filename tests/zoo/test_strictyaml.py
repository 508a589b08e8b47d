"""YAML in which no setting is lost."""

from __future__ import annotations

import pytest

from sb3_sparse.errors import ConfigError
from sb3_sparse.studies import Study
from sb3_sparse.zoo.configs import read_yaml
from sb3_sparse.zoo.spec import RunSpec
from sb3_sparse.zoo.strictyaml import parse


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: 1\nb: 2\na: 3", "the key 'a' is in line 1 and again in line 3"),
        ("a:\n  b: 1\n  b: 1", "the key 'b' is in line 2 and again in line 3"),
        ("a: &x\n  b: 1\n  b: 2\nc: {<<: *x}", "the key 'b' is in line 2 and again in line 3"),
        ("a: [{x: 1, x: 2}]", "the key 'x' is in line 1 and again in line 1"),
        ("a: {<<: {q: 1},\n <<: {r: 1}}", r"the key '<<' .* give a list, <<: \[\*a, \*b\]"),
        ("1: a\n1.0: b", "the key 1.0 is in line 1"),
    ],
)
def test_a_key_that_stands_twice_is_refused_with_its_lines(text, said):
    with pytest.raises(ConfigError, match=said):
        parse(text)


def test_a_merged_mapping_gives_way_to_own_keys_wherever_they_stand():
    text = "a: &x {b: 1, c: 2}\nd:\n  <<: *x\n  b: 3\ne: {b: 4, <<: *x}\nf: {<<: [*x, {g: 5}]}\n"
    assert parse(text) == {
        "a": {"b": 1, "c": 2},
        "d": {"b": 3, "c": 2},
        "e": {"b": 4, "c": 2},
        "f": {"b": 1, "c": 2, "g": 5},
    }


@pytest.mark.parametrize(
    "text", ["a: [", "a: !!float x", "a: 2024-99-99", "a: &x {b: *x}", "a: !!python/name:os.system"]
)
def test_what_is_no_yaml_is_one_line(text):
    with pytest.raises(ConfigError) as caught:
        parse(text)
    assert len(str(caught.value).splitlines()) == 1


def test_every_file_is_read_so(tmp_path):
    path = tmp_path / "mine.yml"
    path.write_text("CartPole-v1: {}\nCartPole-v1: {}\n")
    said = r"mine\.yml is not valid YAML: the key 'CartPole-v1' is in line 1 and again in line 2"
    for read in (
        lambda: read_yaml(path),
        lambda: RunSpec(conf_file=str(path)).settings(),
        lambda: Study.read(str(path), "small"),
    ):
        with pytest.raises(ConfigError, match=said):
            read()


def test_a_file_in_another_encoding_is_named(tmp_path):
    path = tmp_path / "mine.yml"
    path.write_bytes("CartPole-v1: {title: Größe}".encode("latin-1"))
    with pytest.raises(ConfigError, match=r"mine\.yml is not UTF-8 text.*; save it as UTF-8"):
        read_yaml(path)
