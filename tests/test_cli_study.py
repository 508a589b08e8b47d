"""``sb3-sparse study`` as a user meets it."""

from __future__ import annotations

import pytest
import yaml

CELLS = {
    "title": "Two ways to train CartPole",
    "figures": ["curves", "parameters"],
    "common": {"algo": "dqn", "env_id": "CartPole-v1"},
    "runs": [{"method": "dense"}, {"method": "set", "sparsity": 0.5}],
    "scales": {
        "smoke": {
            "n_timesteps": 200,
            "eval_freq": 100,
            "eval_episodes": 1,
            "schedule": {"update_interval": 10},
            "hyperparams": {"learning_starts": 50, "net_arch": [8], "batch_size": 16},
        }
    },
}


def test_a_study_of_ones_own_is_run_looked_at_and_reported(tmp_path, sb3_sparse):
    (tmp_path / "mine.yml").write_text(yaml.safe_dump(CELLS))
    which = ["mine.yml", "--scale", "smoke"]
    _, said, errors = sb3_sparse("study", "status", *which)
    assert "0 done, 0 diverged, 0 running, 0 stopped, 0 failed, 2 waiting" in said, errors

    code, said, errors = sb3_sparse("study", "run", *which, "--workers", "2")
    assert code == 0, said + errors
    assert "2 of 2 runs are done" in said
    assert "Report on them with: sb3-sparse study report mine.yml --scale smoke" in said
    assert len(list((tmp_path / "studies/runs/dqn").iterdir())) == 2

    _, said, _ = sb3_sparse("study", "run", *which)
    assert "2 of 2 runs are already done" in said
    assert "left" not in said  # nothing was run

    code, said, errors = sb3_sparse("study", "report", *which)
    assert code == 0, errors
    page = tmp_path / "studies/mine/smoke/index.html"
    assert f"Written: {page.relative_to(tmp_path)}" in said
    assert "Two ways to train CartPole (smoke)" in page.read_text()
    assert (page.parent / "figures/curves.csv").is_file()


def test_an_unknown_figure_is_known_before_anything_is_run(tmp_path, mistake):
    (tmp_path / "mine.yml").write_text(yaml.safe_dump({**CELLS, "figures": ["curve"]}))
    said = mistake("study", "run", "mine.yml", "--scale", "smoke")
    assert "unknown figure 'curve' (did you mean 'curves'?); allowed are " in said
    assert not (tmp_path / "studies").exists()


def test_an_unknown_finding_is_known_before_anything_is_run(tmp_path, mistake):
    (tmp_path / "mine.yml").write_text(yaml.safe_dump({**CELLS, "findings": ["nois"]}))
    said = mistake("study", "run", "mine.yml", "--scale", "smoke")
    assert "unknown finding 'nois' (did you mean 'noise'?); allowed are equal-parameters" in said
    assert not (tmp_path / "studies").exists()


def test_a_report_of_nothing_is_a_mistake_and_makes_nothing(tmp_path, mistake):
    said = mistake("study", "report", "flops", "--folder", "elsewhere")
    assert "there is no run of this study in elsewhere yet; start with: sb3-sparse study" in said
    assert not (tmp_path / "elsewhere").exists()


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (["run", "figure_1"], "unknown study 'figure_1'; allowed are actor_critic"),
        (
            ["status", "sac", "--scale", "huge"],
            "has no scale 'huge', only smoke, small, medium, paper",
        ),
        (
            ["run", "batch_size", "--scale", "medium"],
            "has no scale 'medium', only smoke, small, paper",
        ),
        (["report", "snr", "--archive", "no.jsonl"], "there is no file no.jsonl; study run --arch"),
        (["run", "flops", "--launcher", "slurm"], "unknown launcher 'slurm'"),
    ],
)
def test_mistakes_are_one_line(args, said, mistake):
    assert said in mistake("study", *args)
