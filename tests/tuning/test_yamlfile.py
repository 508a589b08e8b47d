"""Tuned settings in YAML: read as meant by PyYAML, and merged without touching anything else."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_sparse.errors import ConfigError
from sb3_sparse.tuning.yamlfile import as_yaml, merge_entry

CONFIGS = Path(__file__).parent.parent.parent / "zoo_hparams"
MARK = "Tuned by sb3-sparse"
COMMENT = f"{MARK}: study x, trial 3 of 20 trials, score 1, 2026-01-02"
FILE = """\
# A comment at the top.

default: &base          # an anchor
  n_timesteps: !!float 1e5   # many
  policy: sb3_sparse.SparsePolicy
  policy_kwargs:
    net_arch: [64, 64]
    # why so sparse
    sparsity: 0.9
    weight_decay: !!float 1e-6  # small

# About Walker.
Walker2d-v5:
  <<: *base
  learning_rate: 0.001  # quick

  # after an empty line
  callback:
  - sb3_sparse.SparsityCallback:
      method: rigl

# About Ant.
Ant-v5:
  <<: *base
# the end
"""


def merged(text: str, key: str, wanted: dict) -> str:
    return merge_entry(text, key, wanted, COMMENT, MARK, "file.yml")


def entry(text: str, key: str) -> dict:
    return yaml.safe_load(text)[key]


def test_values_that_are_the_same_leave_everything_but_the_comment():
    new = merged(FILE, "Walker2d-v5", entry(FILE, "Walker2d-v5"))
    lines = new.splitlines()
    at = lines.index(f"  # {COMMENT}")
    assert lines[at - 1] == "Walker2d-v5:"
    del lines[at]
    assert lines == FILE.splitlines()


def test_a_changed_value_changes_its_line_alone():
    wanted = {**entry(FILE, "Walker2d-v5"), "learning_rate": 1e-05}
    new = merged(FILE, "Walker2d-v5", wanted)
    before, after = FILE.splitlines(), new.splitlines()
    after.remove(f"  # {COMMENT}")
    differ = [(b, a) for b, a in zip(before, after, strict=True) if b != a]
    assert differ == [("  learning_rate: 0.001  # quick", "  learning_rate: 1.0e-05  # quick")]


def test_a_value_from_below_is_put_on_top_in_the_entry_itself():
    known = entry(FILE, "Walker2d-v5")
    kwargs = {**known["policy_kwargs"], "weight_decay": 0.001}
    new = merged(FILE, "Walker2d-v5", {**known, "policy_kwargs": kwargs, "gamma": 0.5})
    assert "  policy_kwargs:\n    net_arch: [64, 64]\n    sparsity: 0.9\n" in new
    assert "      method: rigl\n  policy_kwargs:" in new
    assert "  gamma: 0.5\n\n# About Ant.\n" in new
    assert entry(new, "Ant-v5") == entry(FILE, "Ant-v5")


def test_nested_values_change_in_their_places():
    text = FILE.replace("default: &base          # an anchor", "Hopper-v5:").replace(
        "<<: *base", "a: 1"
    )
    known = entry(text, "Hopper-v5")
    kwargs = {**known["policy_kwargs"], "weight_decay": 1e-4, "distribution": "uniform"}
    new = merged(text, "Hopper-v5", {**known, "policy_kwargs": kwargs})
    changed = new[new.index("  policy_kwargs:") : new.index("# About Walker.")]
    assert changed == (
        "  policy_kwargs:\n"
        "    net_arch: [64, 64]\n"
        "    # why so sparse\n"
        "    sparsity: 0.9\n"
        "    weight_decay: 0.0001  # small\n"
        "    distribution: uniform\n"
        "\n"
    )


def test_tuning_again_replaces_the_comment():
    wanted = entry(FILE, "Ant-v5")
    once = merged(FILE, "Ant-v5", wanted)
    again = merge_entry(once, "Ant-v5", wanted, f"{MARK}: study y", MARK, "file.yml")
    assert again.count(MARK) == 1
    assert f"Ant-v5:\n  # {MARK}: study y\n  <<: *base\n# the end\n" in again


def test_a_new_entry_stands_at_the_end_on_top_of_the_default():
    wanted = {**entry(FILE, "default"), "gamma": 0.9}
    new = merged(FILE, "Humanoid-v5", wanted)
    assert new == f"{FILE}\nHumanoid-v5:\n  # {COMMENT}\n  <<: *base\n  gamma: 0.9\n"
    plain = "Ant-v5:\n  gamma: 0.5\n"
    new = merged(plain, "Humanoid-v5", {"gamma": 0.9})
    assert new == f"{plain}\nHumanoid-v5:\n  # {COMMENT}\n  gamma: 0.9\n"


def test_an_entry_that_others_take_their_values_from_is_left_alone():
    with pytest.raises(ConfigError, match="Walker2d-v5, Ant-v5 in file.yml take their values from"):
        merged(FILE, "default", {**entry(FILE, "default"), "gamma": 0.5})


@pytest.mark.parametrize(
    "text",
    [
        "Ant-v5: {gamma: 0.5}\n",
        "Ant-v5: {gamma: 0.5,\n  tau: 1.0}\n",
        "Hopper-v5: &h\n  gamma: 0.5\nAnt-v5: *h\nOther: {a: 1}\n",
        "Ant-v5:\n  gamma: 0.5\n  gamma: 0.6\n",
        "Hopper-v5:\n  gamma: 0.5\n...\n",
        "Hopper-v5: &h\n  gamma: 0.5\nAnt-v5: *h\n",
    ],
)
def test_what_cannot_be_changed_line_by_line_is_refused(text):
    with pytest.raises(ConfigError, match="best.yml by hand|take their values from"):
        merged(text, "Ant-v5", {"gamma": 0.9, "tau": 0.1})


def test_line_endings_and_close_comments_stay():
    text = "Ant-v5:\r\n  gamma: 0.5 # why\r\nOther:\r\n  a: 1\r\n"
    new = merged(text, "Ant-v5", {"gamma": 0.9})
    assert new == text.replace("0.5", "0.9").replace("Ant-v5:", f"Ant-v5:\r\n  # {COMMENT}")


def test_a_key_that_has_to_go_is_refused():
    wanted = entry(FILE, "Walker2d-v5")
    del wanted["learning_rate"]
    with pytest.raises(ConfigError, match="it would differ in learning_rate.*best.yml by hand"):
        merged(FILE, "Walker2d-v5", wanted)


@pytest.mark.parametrize(
    "path", sorted(CONFIGS.glob("*/*.yml")), ids=lambda p: f"{p.parent.name}-{p.stem}"
)
def test_every_shipped_config_takes_tuned_values(path):
    text = path.read_text()
    for key, known in yaml.safe_load(text).items():
        if f"{key}: &" in text:
            continue  # others build on it
        kwargs = {**known["policy_kwargs"], "weight_decay": 3e-05}
        wanted = {**known, "policy_kwargs": kwargs, "learning_rate": 7e-05}
        new = merged(text, key, wanted)
        assert entry(new, key) == wanted
        kept = set(text.splitlines()) - set(new.splitlines())
        assert all("learning_rate" in line or "weight_decay" in line for line in kept)


plain = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False)
    | st.text("ab: #-'\"1e", max_size=8)
)
names = st.text("abcdefgh", min_size=1, max_size=4)
values = st.recursive(
    plain,
    lambda part: st.lists(part, max_size=3) | st.dictionaries(names, part, max_size=3),
    max_leaves=8,
)


@settings(max_examples=200, deadline=None)
@given(st.dictionaries(names, values, min_size=1, max_size=4))
def test_what_is_written_is_read_as_meant(content):
    assert yaml.safe_load(as_yaml(content)) == content


@settings(max_examples=100, deadline=None)
@given(
    st.dictionaries(names, values, min_size=1, max_size=4),
    st.dictionaries(names, values, min_size=1, max_size=4),
    st.dictionaries(names, values, max_size=3),
)
def test_any_entry_can_be_changed_to_any_other_that_keeps_its_keys(first, other, more):
    text = as_yaml({"one": first, "two": other, "three": {"x": 1}})
    wanted = {**other, **more}
    new = merged(text, "two", wanted)
    assert yaml.safe_load(new) == {"one": first, "two": wanted, "three": {"x": 1}}
    assert new.startswith(as_yaml({"one": first}))
    assert new.endswith("three:\n  x: 1\n")
