"""The final masks."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sb3_sparse.errors import SparsityError
from sb3_sparse.loading.zips import look_into
from sb3_sparse.pages.backend import Axes, MaxNLocator
from sb3_sparse.pages.plot import Drawing, Sheet
from sb3_sparse.policies.compiled import plain_names
from sb3_sparse.report.data import Array, RunData
from sb3_sparse.report.figures.base import figure
from sb3_sparse.report.methods import name_of, percent
from sb3_sparse.report.results import NotEnoughData, Results
from sb3_sparse.zoo.folder import env_name

HEADS = ("run", "method", "sparsity", "layer", "shape", "block row", "densities of the blocks")
BLOCKS, LAYERS, CLOSE_TO = 128, 4, 0.9
SIDE, LONG = 2.2, 18  # inches of a panel, letters of a name
ORDER = ("prune", "static", "set", "rigl", "granet", "mst")


@figure(
    "masks",
    "Final masks",
    "Active connections of trained networks, output units downwards, inputs to the right, in at "
    "most 128 by 128 blocks: black is all active, white none. One run a method, at the sparsity "
    "closest to 90 %; the first layers that are sparse, from the observation on.",
)
def draw(results: Results) -> Drawing:
    """Draw a row for each layer, with a panel for each method."""
    remarks: list[str] = []
    shown: list[tuple[RunData, dict[str, tuple[tuple[int, ...], Array]]]] = []
    chosen = _chosen(results)
    with_model = [run for run in chosen if _model_of(run).is_file()]
    if chosen and not with_model:
        raise NotEnoughData("no model is in the runs' folders; an archive holds none")
    remarks += [f"{run.folder}: its model is not there" for run in chosen if run not in with_model]
    for run in with_model:
        try:
            masks = masks_of(run)
        except SparsityError as error:
            remarks.append(f"{run.folder}: its model cannot be read: {error}")
            continue
        if masks:
            shown.append((run, masks))
        else:
            remarks.append(f"{run.folder}: its model has no sparse layer")
    if not shown:
        why = f" {'; '.join(remarks)}" if remarks else ""
        raise NotEnoughData(f"no sparse run has a final model with masks.{why}")
    names = list(dict.fromkeys(name for _, masks in shown for name in masks))[:LAYERS]
    first = shown[0][0]
    algorithm = first.family.rsplit(" on ", 1)[0]
    sheet = Sheet(
        HEADS, len(shown) * len(names), len(shown), SIDE, width=SIDE,
        title=f"{algorithm} on {first.env_id}, {percent(first.level)} sparse",
        x="input", y="output",
    )  # fmt: skip
    for column, (run, masks) in enumerate(shown):
        for row, name in enumerate(names):
            one = sheet.axes[row * len(shown) + column]
            if name in masks:
                _panel(one, *masks[name])
                _note(sheet, run, name, *masks[name])
            else:
                one.set_visible(False)
            head = f"{name_of(run.label)}\n" if row == 0 else ""
            one.set_title(f"{head}{percent(float(f'{density_of(run, name):.2g}'))} active")
            one.tick_params(labelleft=column == 0)
            if column == 0:
                one.set_ylabel(name.replace(".", ".\n", 1) if len(name) > LONG else name)
    return sheet.drawing(remarks)


def _panel(one: Axes, shape: tuple[int, ...], blocks: Array) -> None:
    one.imshow(
        blocks, cmap="Greys", vmin=0, vmax=1, aspect="auto", interpolation="nearest",
        extent=(0, int(np.prod(shape[1:])), shape[0], 0),
    )  # fmt: skip
    one.grid(visible=False)
    for side in ("top", "right"):
        one.spines[side].set_visible(True)
    for axis in (one.xaxis, one.yaxis):
        axis.set_major_locator(MaxNLocator(3, integer=True))


def _note(sheet: Sheet, run: RunData, name: str, shape: tuple[int, ...], blocks: Array) -> None:
    dims = "x".join(map(str, shape))
    for place, densities in enumerate(blocks):
        text = " ".join(f"{density:.3g}" for density in densities)
        sheet.rows.append([run.folder.name, run.label, run.level, name, dims, place, text])


def _chosen(results: Results) -> list[RunData]:
    """Choose one run of each method, of the first family and task with sparse runs."""
    sparse = [run for run in results.main if run.label in ORDER]
    if not sparse:
        return []
    place = min((run.family, run.env_id) for run in sparse)
    here = [run for run in sparse if (run.family, run.env_id) == place]
    level = min((run.level for run in here), key=lambda level: (abs(level - CLOSE_TO), level))
    at = sorted((run for run in here if run.level == level), key=lambda run: run.seed)
    return [run for label in ORDER for run in [r for r in at if r.label == label][:1]]


def masks_of(run: RunData) -> dict[str, tuple[tuple[int, ...], Array]]:
    """Read shapes and block densities of the first sparse layers' masks from the final model.

    :raises ConfigError: if there is no model
    :raises CorruptStateError: if it is damaged
    """
    state, found = plain_names(look_into(_model_of(run)).state), {}
    for layer in run.layers:
        mask = state.get(f"{layer['name']}.weight_mask")
        if mask is not None and mask.dim() > 1 and density_of(run, layer["name"]) < 1:
            flat = mask.reshape(mask.shape[0], -1).numpy().astype(np.float64)
            found[str(layer["name"])] = (tuple(mask.shape), blocks_of(flat))
    return found


def _model_of(run: RunData) -> Path:
    return Path(run.folder) / f"{env_name(run.env_id)}.zip"


def density_of(run: RunData, name: str) -> float:
    """Return the share of a layer's connections that are active."""
    layer = next(layer for layer in run.layers if layer["name"] == name)
    return float(layer["nnz"]) / float(np.prod(layer["shape"]))


def blocks_of(mask: Array, most: int = BLOCKS) -> Array:
    """Average a matrix over at most ``most`` by ``most`` blocks of almost equal size."""
    for axis in (0, 1):
        size = mask.shape[axis]
        if size > most:
            starts = np.linspace(0, size, most, endpoint=False).astype(int)
            counts = np.diff([*starts, size])
            sums = np.add.reduceat(mask, starts, axis=axis)
            mask = sums / (counts[:, None] if axis == 0 else counts[None, :])
    return mask
