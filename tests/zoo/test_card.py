"""Model cards: what the Hub reads, and whether what they tell readers to do works."""

from __future__ import annotations

import json
import re
import shlex
import shutil

import numpy as np
import pytest
import torch as th
import yaml
from huggingface_hub import ModelCard, metadata_eval_result
from PIL import Image
from stable_baselines3 import DQN

from sb3_sparse import cli
from sb3_sparse.errors import ConfigError, CorruptStateError
from sb3_sparse.zoo import Card, RunSpec, train
from sb3_sparse.zoo.curve import curve

QUICK = dict(net_arch=[24, 24], batch_size=16, learning_starts=20, update_interval=10)
REPO = "me/dqn-CartPole-v1"


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    run = RunSpec(
        n_timesteps=600, eval_freq=200, eval_episodes=3, seed=4, hyperparams=QUICK, sparsity=0.8
    )
    return train(run, tmp_path_factory.mktemp("card")).folder


@pytest.fixture
def folder(trained, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return shutil.copytree(trained, tmp_path / "logs" / "CartPole-v1_1")


def result_of(folder, what):
    results = json.loads((folder / "sparsity.json").read_text())["results"]
    (found,) = [one for one in results if one["what"] == what]
    return found


def blocks(text, language):
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


@pytest.mark.parametrize(("best", "what"), [(False, "Last policy"), (True, "Best policy")])
def test_the_hub_reads_what_it_reads_of_huggingface_sb3(folder, best, what):
    path = Card.of(folder, best=best, repo_id=REPO).write()
    one = result_of(folder, what)
    expected = metadata_eval_result(
        model_pretty_name="DQN",
        task_pretty_name="reinforcement-learning",
        task_id="reinforcement-learning",
        metrics_pretty_name="mean_reward",
        metrics_id="mean_reward",
        metrics_value=f"{one['mean_return']:.2f} +/- {one['std_return']:.2f}",
        dataset_pretty_name="CartPole-v1",
        dataset_id="CartPole-v1",
    )
    written = yaml.safe_load(path.read_text().split("---\n")[1])
    assert written.pop("library_name") == "stable-baselines3"
    assert written.pop("tags") == [
        "CartPole-v1",
        "deep-reinforcement-learning",
        "reinforcement-learning",
        "stable-baselines3",
        "sparse-training",
    ]
    assert written == expected
    card = ModelCard.load(path)
    (found,) = card.data.eval_results
    assert found.metric_value == f"{one['mean_return']:.2f} +/- {one['std_return']:.2f}"
    assert card.text.lstrip().startswith("# DQN on CartPole-v1, RigL at 79.4% sparsity\n")
    assert (
        f"| {what} | {one['mean_return']:.2f} | {one['std_return']:.2f} | 3 | `{one['path']}` |"
        in card.text
    )


def test_connections_are_those_of_the_weights_and_the_score_is_that_of_the_evaluations(folder):
    text = str(Card.of(folder, repo_id=REPO))
    weights = DQN.load(folder / "CartPole-v1.zip").q_net.q_net.parameters()
    matrices = [one.detach().numpy() for one in weights if one.dim() == 2]
    active = sum(map(np.count_nonzero, matrices))
    size = 4 * 24 + 24 * 24 + 24 * 2
    wanted = re.search(r"^([\d,]+) of ([\d,]+) connections are active", text, re.MULTILINE)
    nnz, of = (int(number.replace(",", "")) for number in wanted.groups())
    assert of == size
    assert active <= nnz <= round(0.21 * size)  # a connection that has grown last is still 0
    with np.load(folder / "evaluations.npz") as saved:
        assert f"it is {saved['results'][-1].mean():.2f}" in text


def test_the_card_works_as_it_says(folder, tmp_path, capsys):
    path = Card.of(folder, best=True, repo_id=REPO).write()
    text = path.read_text()
    assert "![Learning curve](curve.png)" in text
    with Image.open(folder / "curve.png") as picture:
        assert min(picture.size) > 300
    shutil.copytree(folder, tmp_path / "dqn-CartPole-v1")  # as hf download does
    loading, training = blocks(text, "sh")
    install, download, *commands = loading.splitlines()
    assert install == 'pip install "sb3-sparse[zoo]" huggingface_hub'
    assert download == f"hf download {REPO} --local-dir dqn-CartPole-v1"
    assert [line.split()[1] for line in commands] == ["enjoy", "inspect"]
    for line in commands:
        cli.app(shlex.split(line)[1:], standalone_mode=False)
    assert "Best policy:" in capsys.readouterr().out
    names: dict[str, object] = {}
    for code in blocks(text, "python"):
        exec(compile(code, "README.md", "exec"), names)
    best = DQN.load(folder / "best_model.zip").policy.state_dict()
    found = names["model"].policy.state_dict()
    assert all(th.equal(found[name], value) for name, value in best.items())
    assert names["actions"].shape == (1,)

    (settings,) = blocks(text, "yaml")
    (tmp_path / "settings.yml").write_text(settings)
    cli.app(shlex.split(training)[1:], standalone_mode=False)
    again = tmp_path / "logs" / "dqn" / "CartPole-v1_1"
    assert result_of(again, "Last policy") == result_of(folder, "Last policy")
    assert (again / "best_model.zip").is_file()


def test_the_command_writes_the_card_and_says_how_to_upload(folder, capsys):
    cli.app(["card", str(folder)], standalone_mode=False)
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith(f"Wrote {folder}/README.md")
    words = shlex.split(said[1])
    assert words[:4] == ["hf", "upload", "YOUR-NAME/dqn-CartPole-v1", str(folder)]
    assert words[4:] == ["--exclude", "*/command.txt"]
    assert "--repo-id" in said[2]
    before = (folder / "README.md").read_bytes()
    cli.app(["card", str(folder), "--repo-id", REPO], standalone_mode=False)
    assert "--repo-id" not in capsys.readouterr().out
    assert (folder / "README.md").read_bytes() == before.replace(b"YOUR-NAME", b"me")


def test_a_dense_run_is_not_called_sparse(tmp_path):
    run = RunSpec(method="dense", n_timesteps=200, eval_freq=100, eval_episodes=1, seed=1)
    card = Card.of(train(run, tmp_path).folder)
    assert "sparse-training" not in card.metadata["tags"]
    text = str(card)
    assert "# DQN on CartPole-v1, dense\n" in text
    assert "standard deviation over its" not in text  # there is one episode


def test_algorithms_of_sb3_contrib_are_imported_from_there(tmp_path):
    run = RunSpec(
        "trpo", "Pendulum-v1", n_timesteps=64, eval_freq=64, eval_episodes=1,
        hyperparams=dict(net_arch=[24, 24], n_steps=16, batch_size=16, update_interval=10),
    )  # fmt: skip
    text = str(Card.of(train(run, tmp_path).folder))
    code = blocks(text, "python")[1]
    assert code.splitlines()[:2] == [
        "import sb3_sparse  # registers the sparse policies",
        "from sb3_contrib import TRPO",
    ]


def test_runs_that_get_no_card(folder, tmp_path):
    with pytest.raises(ConfigError, match="there is no run of sb3-sparse in"):
        Card.of(tmp_path)
    for wrong in ("me", "me/", "/model", "me/a/b", "me/a b"):
        with pytest.raises(ConfigError, match="repo_id must be name/model, e.g. me/dqn-CartPole"):
            Card.of(folder, repo_id=wrong)
    (folder / "best_model.zip").unlink()
    with pytest.raises(ConfigError, match=r"has no best_model\.zip"):
        Card.of(folder, best=True)
    path = folder / "sparsity.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps({**content, "results": [{"what": "Last policy"}]}))
    with pytest.raises(CorruptStateError, match=r"sparsity\.json is damaged.*mean_return"):
        str(Card.of(folder))
    path.write_text(json.dumps({**content, "status": "interrupted"}))
    with pytest.raises(ConfigError, match=r"'interrupted'.*sb3-sparse train --resume"):
        Card.of(folder)
    assert not (folder / "README.md").exists()


def test_the_curve_is_the_mean_with_a_standard_deviation_on_each_side():
    returns = np.array([[1.0, 3.0], [10.0, 10.0]])
    rows = curve("a run", np.array([100, 200]), returns).rows
    assert rows == [[100, 2.0, 1.0, 3.0, 2], [200, 10.0, 10.0, 10.0, 2]]
    (one,) = curve("a run", np.array([100]), returns[:1, :1]).rows
    assert one[:2] == [100, 1.0]
    assert np.isnan(one[2:4]).all()
