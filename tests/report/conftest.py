"""Run folders on disk, made up, with known scores."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th

HIDDEN = 64


class Folders:
    """Makes run folders below one folder."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.made: list[Path] = []

    def add(
        self,
        method: str = "rigl",
        sparsity: float | None = 0.9,
        seed: int = 0,
        score: float | list[float] = 300.0,
        *,
        env_id: str = "CartPole-v1",
        algo: str = "dqn",
        match: float | None = None,
        policy: dict[str, Any] | None = None,
        callback: dict[str, Any] | None = None,
        settings: dict[str, Any] | None = None,
        overrides: dict[str, Any] | None = None,
        status: str = "finished",
        evaluations: int = 10,
        model: bool = False,
        share: float | None = None,
        size: float = 1.0,
        snr: dict[str, float] | None = None,
        noise: dict[float, float] | None = None,
        seconds: float | None = None,
    ) -> Path:
        """One run. Its last evaluation is the score."""
        folder = self.root / f"{len(self.made):04d}" / algo / f"{env_id.replace('/', '-')}_1"
        folder.mkdir(parents=True)
        self.made.append(folder)
        removed = 0.0 if method == "dense" else float(sparsity or 0)
        shrunk = (1 - (match or 0.0)) * size
        kwargs: dict[str, Any] = {"net_arch": [round(HIDDEN * shrunk) or 1], **(policy or {})}
        entry: dict[str, Any] = {
            "n_timesteps": 1000,
            "batch_size": 32,
            **(settings or {}),
            "policy_kwargs": kwargs,
        }
        if method != "dense":
            kwargs["sparsity"] = removed
            entry["callback"] = [
                {"sb3_sparse.SparsityCallback": {"method": method, **(callback or {})}}
            ]
        layers = self._layers(removed, shrunk, share)
        record = {
            "format": 1,
            "status": status,
            "method": method,
            "run": {
                "algo": algo, "env_id": env_id, "method": method, "sparsity": sparsity,
                "distribution": None, "seed": seed, "n_timesteps": 1000,
                "hyperparams": overrides or {}, "conf_file": None, "match_params": match,
                "eval_freq": 100, "eval_episodes": 2,
            },
            "settings": entry,
            "total": {
                "sparsity": removed,
                "nnz": sum(layer["nnz"] for layer in layers),
                "parameters": sum(layer["nnz"] for layer in layers) + 10,
                "flops": sum(layer["flops"] for layer in layers),
                "dense_flops": sum(layer["dense_flops"] for layer in layers),
            },
            "networks": {},
            "layers": layers,
            "versions": {"python": "3.11", "torch": "2.13.0"},
        }  # fmt: skip
        if seconds is not None:
            record["seconds"] = {"wall": 2 * seconds, "processor": seconds}
        (folder / "sparsity.json").write_text(json.dumps(record))
        if status == "finished":
            means = score if isinstance(score, list) else [score] * evaluations
            steps = 100 * np.arange(1, len(means) + 1)
            results = np.array(means)[:, None] + np.array([-1.0, 1.0])
            np.savez(folder / "evaluations.npz", timesteps=steps, results=results)
        if model:
            self._model(folder / f"{env_id.replace('/', '-')}.zip", layers)
        if snr:
            rows = [f"{step},{name},{v}" for name, v in snr.items() for step in (100, 200, 300)]
            (folder / "snr.csv").write_text("\n".join(["timesteps,name,value", *rows]) + "\n")
        if noise:
            rows = [f"{s},{x},0,{v + x}" for s, v in noise.items() for x in (-1, 1)]
            (folder / "robustness.csv").write_text(
                "\n".join(["sigma,seed,episode,return", *rows]) + "\n"
            )
        return folder

    def _layers(self, removed: float, shrunk: float, share: float | None) -> list[dict[str, Any]]:
        networks = {"q_net": 1.0} if share is None else {"actor": share, "critic": 1 - share}
        layers = []
        for network, part in networks.items():
            size = HIDDEN * HIDDEN
            nnz = round(size * (1 - removed) * shrunk * part)
            layers.append(
                {
                    "network": network, "name": f"{network}.0", "shape": [HIDDEN, HIDDEN],
                    "nnz": nnz, "parameters": nnz, "flops": 2 * nnz, "dense_flops": 2 * size,
                    "in_budget": True, "size": size, "density": nnz / size,
                }
            )  # fmt: skip
        return layers

    def _model(self, path: Path, layers: list[dict[str, Any]]) -> None:
        state = {}
        for layer in layers:
            mask = th.zeros(HIDDEN * HIDDEN, dtype=th.bool)
            mask[: layer["nnz"]] = True
            state[f"{layer['name']}.weight_mask"] = mask.reshape(HIDDEN, HIDDEN)
        content = io.BytesIO()
        th.save(state, content)
        with zipfile.ZipFile(path, "w") as file:
            file.writestr("data", "{}")
            file.writestr("policy.pth", content.getvalue())


@pytest.fixture
def folders(tmp_path):
    return Folders(tmp_path / "runs")


@pytest.fixture(scope="module")
def study_folders(tmp_path_factory):
    """Everything that any figure wants: two tasks, all methods, two sparsities, three seeds."""
    made = Folders(tmp_path_factory.mktemp("study"))
    rng = np.random.default_rng(0)
    labels = ["dense", "equal", "prune", "static", "set", "rigl"]
    for env_id in ("CartPole-v1", "Acrobot-v1"):
        start = 400.0 if env_id == "CartPole-v1" else -150.0
        for seed in range(3):
            for place, label in enumerate(labels):
                for level in (0.0,) if label == "dense" else (0.8, 0.95):
                    end = start - 30 * (5 - place) * (level > 0) + rng.normal(0, 5)
                    curve = list(np.linspace(start - 100, end, 10))
                    dense = label in ("dense", "equal")
                    made.add(
                        "dense" if dense else label,
                        None if dense else level,
                        seed,
                        curve,
                        env_id=env_id,
                        match=level if label == "equal" else None,
                        model=not dense,
                        snr={"snr/q_net": 0.1 * (1 - level / 2), "snr/q_net/active": 0.2},
                        noise={0.0: end, 0.5: end - 5, 1.0: end - 20 - 10 * dense},
                    )
            for decay in (1e-6, 1e-3):
                made.add(
                    "rigl", 0.8, seed, start + 10 * (decay < 1e-4), env_id=env_id,
                    policy={"weight_decay": decay}, overrides={"weight_decay": decay},
                )  # fmt: skip
            made.add(
                "rigl", 0.8, seed, start - 40, env_id=env_id,
                policy={"distribution": "uniform"}, overrides={"distribution": "uniform"},
            )  # fmt: skip
    for seed in range(3):
        for share in (0.1, 0.34, 0.9):
            asked = {"actor_share": share} if share != 0.34 else {}
            made.add(
                "rigl", 0.8, seed, 1000 - 500 * (share > 0.5), env_id="Hopper-v5", algo="sac",
                share=share, policy=asked, overrides=asked,
            )  # fmt: skip
        made.add("dense", None, seed, 1000.0, env_id="Hopper-v5", algo="sac", share=0.34)
        for width in (256, 512):
            for label, match in (("dense", None), ("dense", 0.9), ("rigl", None)):
                made.add(
                    label, None if label == "dense" else 0.9, seed, width + 10.0 * seed,
                    env_id="HalfCheetah-v5", algo="sac", match=match, size=width / 512,
                    seconds=width * (1.0 if label == "dense" else 0.5),
                    overrides={"net_arch": [width]},
                    policy={} if match else {"net_arch": [width]},
                )  # fmt: skip
    made.add("rigl", 0.9, 0, env_id="ALE/Pong-v5", status="counted")
    return made.made
