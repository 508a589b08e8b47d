"""What ``sb3-sparse train`` tells at the end: returns, sizes, times, and what to do next."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sb3_sparse.cli.common import print_score, say
from sb3_sparse.errors import SparsityError, command
from sb3_sparse.pages.numbers import counted, short

if TYPE_CHECKING:
    from collections.abc import Iterable

    from sb3_sparse.policies.report import LayerReport
    from sb3_sparse.zoo.results import Outcome

SHORT = 1e-3  # by how much rounding may miss a sparsity
SMALL = 1_000_000  # parameters, if dense, of acting networks that are exported and timed


def tell(outcome: Outcome) -> None:
    """Print how a finished run ended, and three commands to go on with.

    What cannot be measured here is left out, with the reason: the run has ended well by now, and no
    error of a measurement may fail it.
    """
    results = outcome.results
    played = counted(results[0].episodes, "episode")
    say(f"Sparsity {outcome.sparsity:.2%}. Return over {played}:")
    for result in results:
        print_score(f"{result.what}:", result.mean_return, result.std_return, result.path)
    if len(results) > 1:
        say("The best policy was chosen on other episodes.")
    if outcome.sparsity < outcome.wanted_sparsity - SHORT:
        say(
            f"The run should have reached {outcome.wanted_sparsity:.2%}, but too few mask updates "
            "were due. Train longer, or with a smaller update_interval; reports leave this run out."
        )
    _tell_costs(outcome)
    _tell_curve(outcome)
    best = ["--best"] if results[-1].mean_return > results[0].mean_return else []
    say("Next, look at it, deploy it, or compare methods:")
    say(command("enjoy", outcome.folder, *best))
    say(command("export", outcome.folder, *best, "--to", "c", "policy.c"))
    say(command("study", "list"))


def _tell_costs(outcome: Outcome) -> None:
    """Print the policy's parameters, and its bytes and time in C."""
    from sb3_sparse.policies.base import BaseSparsePolicy
    from sb3_sparse.policies.compiled import unwrapped

    policy = unwrapped(outcome.model.policy)
    assert isinstance(policy, BaseSparsePolicy)
    report = policy.sparsity_report()
    dense = dense_parameters(report.layers)
    say(f"{'':<26}{'trained':>10}{'dense':>12}")
    say(f"{'Parameters, all networks':<26}{report.parameters:>10,}{dense:>12,}")
    acting = tuple(f"{name}." for name in policy.acting)
    acts = [layer for layer in report.layers if f"{layer.name}.".startswith(acting)]
    if dense_parameters(acts) > SMALL:
        say(f"Not exported and timed, as policies above {SMALL:,} parameters take too long here.")
        return
    try:
        from sb3_sparse.export.timing import acting_cost

        cost = acting_cost(outcome.model)
    except Exception as error:
        say(f"No size and time in C: {_reason(error)}")
        return
    say(f"{'Policy in C, bytes':<26}{cost.flash:>10,}{cost.dense_bytes:>12,}")
    times = f"{short(cost.c)} in C, {short(cost.predict)} by predict"
    say(f"{'An action, microseconds':<26}{times}, one thread")


def dense_parameters(layers: Iterable[LayerReport]) -> int:
    """Return the parameters, biases included, that layers would have if dense."""
    return sum(layer.size - layer.nnz + layer.parameters for layer in layers)


def _tell_curve(outcome: Outcome) -> None:
    """Draw the learning curve into the run's folder."""
    from sb3_sparse.zoo.folder import RunFolder

    folder = RunFolder(outcome.folder)
    try:
        from sb3_sparse.zoo.curve import what_was_trained, write_curve

        record = folder.record()
        title = what_was_trained(record.spec, str(record["method"]), outcome.sparsity)
        drawn = write_curve(folder, title)
    except Exception as error:
        say(f"No learning curve: {_reason(error)}")
        return
    if drawn is None:
        say(
            "No learning curve, no best policy: no evaluation was due during training. Train "
            "longer (-n), or evaluate more often (--eval-freq)."
        )
    else:
        say(f"Learning curve: {drawn}")


def _reason(error: Exception) -> str:
    """Return why something is left out: our errors say it, others need their name."""
    return str(error) if isinstance(error, SparsityError) else f"{type(error).__name__}: {error}"
