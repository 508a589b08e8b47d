"""``sb3-sparse card``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sb3_sparse.cli.common import Best, option, say


def card_command(
    run: Annotated[Path, typer.Argument(help="The folder of a finished run.")],
    best: Best = False,
    repo_id: Annotated[
        str | None,
        option("Repository on the Hub, as name/model.", shown="YOUR-NAME/<algo>-<env>"),
    ] = None,
) -> None:
    """Write a model card for the Hugging Face Hub beside a run: README.md and curve.png."""
    from sb3_sparse.zoo.card import Card

    card = Card.of(run, best=best, repo_id=repo_id)
    say(f"Wrote {card.write()}, with its learning curve beside it. Upload the run:")
    say(card.push)
    if repo_id is None:
        say("--repo-id puts the repository's name into the card, too.")
