"""Output positions of the convolutions of known networks, from shapes alone."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

Shape = tuple[int, ...]
NATURE = ((0, 8, 4), (2, 4, 2), (4, 3, 1))
"""Number in the Sequential, kernel and stride of a NatureCNN's convolutions."""
IMPALA = (0, 4, 8)
"""Numbers of the convolutions that begin an Impala network's stacks."""
END = ".cnn.0"


def image_in(space: Any) -> Shape | None:
    """Return the shape of the images in an observation space, as SB3 writes it beside the pickle.

    :param space: the space's plain values from a zip
    :return: channels first; None if there are no images, or several
    """
    if not isinstance(space, Mapping):
        return None
    shape = space.get("_shape")
    if isinstance(shape, list):
        return _image(shape)
    parts = str(space.get("spaces", "")).split("Box(")[1:]
    found = {image for part in parts if (image := _image_in_text(part)) is not None}
    return found.pop() if len(found) == 1 else None


def _image(shape: list[Any]) -> Shape | None:
    fits = len(shape) == 3 and all(type(size) is int and 0 < size < 2**15 for size in shape)
    return tuple(shape) if fits else None


def _image_in_text(text: str) -> Shape | None:
    """Parse the printed form of a Box: bounds, ``(1, 36, 36)``, dtype."""
    if "uint8" not in text or "(" not in text:
        return None
    numbers = text.split("(")[-1].split(")")[0].split(",")
    return _image([int(one) for one in numbers if one.strip().isdigit()])


def positions_of(shapes: Mapping[str, Shape], image: Shape | None) -> dict[str, int]:
    """Return the output positions of each convolution whose strides are known, by name.

    They are returned only if they give the number of inputs of the layer that follows.

    :param shapes: weight shapes of all layers by dotted name
    :param image: channels, height and width of the observed images; None: unknown
    """
    found: dict[str, int] = {}
    if image is None:
        return found
    size = image[1:]
    for name in shapes:
        if not name.endswith(END):
            continue
        root = name.removesuffix(END)
        own = {key: one for key, one in shapes.items() if key.startswith(f"{root}.cnn.")}
        make = _impala if any(".layers." in key for key in own) else _nature
        positions, outputs = make(f"{root}.cnn", own, size)
        after = shapes.get(f"{root}.linear.0")
        if set(positions) == set(own) and after is not None and after[1] == outputs:
            found |= positions
    return found


def _nature(root: str, own: Mapping[str, Shape], size: Shape) -> tuple[dict[str, int], int]:
    positions: dict[str, int] = {}
    channels = 0
    for number, kernel, stride in NATURE:
        shape = own.get(f"{root}.{number}")
        if shape is None or shape[2:] != (kernel, kernel):
            return {}, 0
        channels = shape[0]
        size = tuple((side - kernel) // stride + 1 for side in size)
        positions[f"{root}.{number}"] = math.prod(size)
    return positions, channels * math.prod(size)


def _impala(root: str, own: Mapping[str, Shape], size: Shape) -> tuple[dict[str, int], int]:
    positions: dict[str, int] = {}
    channels = 0
    for number in IMPALA:
        first = own.get(f"{root}.{number}")
        if first is None:
            return {}, 0
        channels = first[0]
        positions[f"{root}.{number}"] = math.prod(size)
        size = tuple((side + 1) // 2 for side in size)
        for block in (number + 2, number + 3):
            for layer in (1, 3):
                positions[f"{root}.{block}.layers.{layer}"] = math.prod(size)
    return positions, channels * math.prod(size)
