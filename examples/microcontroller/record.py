"""Records what a policy sees, and compares what a microcontroller makes of it.

python record.py RUN                       # writes observations.h and actions.npy
make run | python record.py --compare      # the program's actions beside the model's
"""

import argparse
import re
import sys
from pathlib import Path

import numpy as np

UNCOUNTED = 2**32 - 1
"""Stands for more ticks than the timer counts, which has 24 bits."""


def header(observations: np.ndarray) -> str:
    """A C header with a row for each observation; hexadecimal floats lose nothing."""
    rows = observations.astype(np.float32).reshape(len(observations), -1)
    body = ",\n".join("    {" + ", ".join(f"{float(x).hex()}f" for x in row) + "}" for row in rows)
    return (
        f"#define OBSERVATIONS {len(rows)}\n\n"
        f"static const float observations[OBSERVATIONS][{rows.shape[1]}] = {{\n{body}\n}};\n"
    )


def sections(text: str) -> dict[str, int]:
    """Bytes of each section of policy.o in the map of what was linked.

    :param text: contents of firmware.map
    """
    text = text[text.index("Linker script and memory map") :]  # before: what was left out
    found: dict[str, int] = {}
    pattern = r"^ (\.\S+)\s+0x[0-9a-f]+\s+0x([0-9a-f]+)\s+\S*policy\.o$"
    for name, size in re.findall(pattern, text, re.M):
        found[name] = found.get(name, 0) + int(size, 16)
    return found


def record(run: Path, count: int, into: Path) -> None:
    """Write raw observations of a run's environment, and the model's actions on them."""
    from gymnasium import spaces
    from stable_baselines3.common.vec_env import unwrap_vec_normalize

    from sb3_sparse.export import record_observations
    from sb3_sparse.zoo.saved import SavedModel

    saved = SavedModel.find(run)
    model = saved.load()
    if isinstance(model.observation_space, spaces.Dict):
        sys.exit(
            f"{run} has dicts as observations, and this example writes arrays; write rows of "
            "their parts, in the order that policy.h gives, to observations.h by yourself"
        )
    envs = saved.evaluation_envs(count, 0)
    seen = observations = record_observations(model, envs, count)
    if (normalization := unwrap_vec_normalize(envs)) is not None:
        seen = normalization.normalize_obs(observations)
    actions, _ = model.predict(seen, deterministic=True)
    (into / "observations.h").write_text(header(observations))
    np.save(into / "actions.npy", actions.reshape(count, -1).astype(np.float32))


def read(text: str) -> tuple[np.ndarray, np.ndarray, int]:
    """Actions, ticks of each (:data:`UNCOUNTED` if too many), and bytes of stack, as printed."""
    rows = re.findall(r"^(?:[0-9a-f]{8} )+[0-9a-f]{8}$", text, re.M)
    stack = re.search(r"^stack ([0-9a-f]{8})$", text, re.M)
    if stack is None:
        sys.exit(f"the program did not get to its end; it printed last: {text[-200:]!r}")
    numbers = np.array([[int(word, 16) for word in row.split()] for row in rows], np.uint32)
    return numbers[:, :-1].copy().view(np.float32), numbers[:, -1], int(stack[1], 16)


def compare(text: str, folder: Path, within: float) -> None:
    """Print how far the actions are from the model's; exit with 1 if that is too far."""
    actions, ticks, stack = read(text)
    expected = np.load(folder / "actions.npy")
    difference = np.abs(actions - expected) / np.maximum(1, np.abs(expected))
    print(f"{len(actions)} actions differ from model.predict by {difference.max():.2g} at most")
    if (ticks == UNCOUNTED).any():
        taken = "more ticks an action than the 16,777,215 that the timer counts"
    else:
        taken = f"{ticks.mean():.0f} ticks of the timer an action"
    print(f"{taken}, {stack} bytes of stack")
    if not difference.max() <= within:
        sys.exit(f"more than {within:g}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, nargs="?", help="a run's folder")
    parser.add_argument("--count", type=int, default=1000, help="number of observations")
    parser.add_argument("--folder", type=Path, default=Path(), help="where the two files are")
    parser.add_argument("--compare", action="store_true", help="read a program's output")
    parser.add_argument("--within", type=float, default=1e-5, help="difference that is allowed")
    args = parser.parse_args()
    if args.compare:
        compare(sys.stdin.read(), args.folder, args.within)
    elif args.run is None:
        parser.error("name a run's folder, or --compare")
    else:
        record(args.run, args.count, args.folder)


if __name__ == "__main__":
    main()
