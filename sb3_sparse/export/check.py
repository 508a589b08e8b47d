"""Compares what an export writes with the model, before it is written."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_sparse.errors import MissingExtra, UnsupportedError
from sb3_sparse.export.extract import span_of
from sb3_sparse.export.failure import failure_of
from sb3_sparse.export.observations import Observations, has_images, random_observations
from sb3_sparse.export.parity import Actor, Parity, ParityError, compare
from sb3_sparse.export.reference import predictor, rounded
from sb3_sparse.export.written import Written
from sb3_sparse.policies.compiled import unwrapped

RANDOM = 1000
RANDOM_IMAGES = 100


@dataclass(frozen=True)
class Checked:
    """The outcome of a check.

    :param own: acts as the model does
    :param actor: acts as the export does; None: it cannot run here
    :param parity: how closely the export acts as the model, or as the rounded one; None: unknown
    :param rounding: how much 8-bit numbers change the actions; None: there are none
    :param notes: what the user must know
    """

    own: Actor
    actor: Actor | None = None
    parity: Parity | None = None
    rounding: Parity | None = None
    notes: tuple[str, ...] = ()


def check(
    written: Written,
    given: BaseAlgorithm,
    model: BaseAlgorithm,
    observations: Observations | None,
    force: bool,
) -> Checked:
    """Run the export beside the model.

    :param given: the model, of SB3 or SBX
    :param model: the same, of SB3
    :param observations: recorded observations; None: none
    :param force: note a failure instead of raising it
    :raises ParityError: if the export does not act as the model
    :raises UnsupportedError: if there is no C compiler
    :raises MissingExtra: if the export needs a package that is not installed
    """
    space, further = model.observation_space, written.further
    own = predictor(given, written.normalization, list(further), unwrapped(model.policy))
    try:
        actor = written.artifact.actor()
    except (UnsupportedError, MissingExtra) as error:
        if not force:
            raise
        return Checked(own, notes=(f"written unchecked, as you asked: {error}",))
    count = RANDOM_IMAGES if has_images(space) else RANDOM
    random = random_observations(space, written.normalization, count)
    compared = partial(
        compare,
        discrete=not isinstance(model.action_space, spaces.Box),
        span=span_of(model),
        further=further,
    )
    if written.graph is None or written.int8 is None:
        parity, rounding = compared(own, actor, observations, random), None
    else:
        parity = compared(rounded(written.graph, actor), actor, observations, random)
        # Whole numbers have the ranges of recorded observations.
        met = None if written.int8 == "full" else random
        rounding = compared(own, actor, observations, met)
    if parity.holds:
        return Checked(own, actor, parity, rounding)
    failure = failure_of(parity, written.graph)
    if not force:
        raise ParityError(
            f"the export to {written.to!r} does not act as the model: {failure}. Nothing was "
            "written; --force (force=True) writes it all the same"
        )
    note = f"written although it does not act as the model, as you asked: {failure}"
    return Checked(own, actor, parity, rounding, (note,))
