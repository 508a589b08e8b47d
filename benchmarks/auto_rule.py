"""What the rule of ``compute="auto"`` loses, for sparse_compute.py."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

from compute_rows import rows_of
from gradient_steps import Case, Variant
from rounds import interleaved

from sb3_sparse.engine.native.library import in_use, use

BEHIND = 0.05
"""How much slower than the better storage auto may be, as a share."""


def sparse_layers(model: Any) -> tuple[str, ...]:
    layers = model.policy.sparsity_report().layers
    return tuple(layer.name for layer in layers if layer.compute == "sparse")


def time_rule(
    case: Case, sparsity: float, sets: list[str], rounds: int
) -> Iterator[dict[str, Any]]:
    """Time gradient steps with masks, in sparse storage and by the rule, in each instruction set.

    Where auto stores the same layers as one of the others, it is the same program and gets its
    times.
    """
    before = in_use()
    made = {name: case.make_sparse(sparsity, name) for name in ("masked", "sparse")}
    known = {sparse_layers(model): name for name, (model, _, _) in made.items()}

    def stepped(variant: Variant, instructions: str) -> Callable[[], None]:
        def run() -> None:
            use(instructions)
            variant[1]()

        return run

    todo = {"masked": stepped(made["masked"], sets[0])}  # no kernel of ours is in it
    todo |= {f"sparse {one}": stepped(made["sparse"], one) for one in sets}
    same = {}
    for one in sets:
        use(one)  # the rule goes by it
        auto = case.make_sparse(sparsity, "auto")
        name = known.get(sparse_layers(auto[0]))
        if name is None:
            todo[f"auto {one}"] = stepped(auto, one)
        else:
            same[f"auto {one}"] = name if name == "masked" else f"sparse {one}"
    times = interleaved(todo, rounds)
    use(before)
    times |= {name: times[other] for name, other in same.items()}
    yield from rows_of("rule", case.name, case.batch, sparsity, times, case.steps)


def print_rule(rows: Iterable[Mapping[str, Any]]) -> None:
    """Print how far auto is behind the better storage and masks, and where by more than 5 %."""
    cases: dict[tuple[str, str], dict[str, float]] = {}
    for row in rows:
        if row["what"] == "rule":
            case = cases.setdefault((row["case"], f"{float(row['sparsity']):.0%}"), {})
            case[row["variant"]] = float(row["speedup"])
    better, masked = {}, {}
    for (case, sparsity), speedups in cases.items():
        for variant in [name for name in speedups if name.startswith("auto ")]:
            one = variant.removeprefix("auto ")
            auto, sparse = speedups[variant], speedups[f"sparse {one}"]
            told = f"{case} {sparsity} {one}: auto {auto:.2f}x, sparse {sparse:.2f}x of masked"
            better[told] = max(1.0, sparse) / auto - 1
            masked[told] = 1 / auto - 1
    for name, shares in (("the better storage", better), ("masked", masked)):
        worst = sorted(shares, key=lambda told: -shares[told])
        beyond = [told for told in worst if shares[told] > BEHIND]
        print(
            f"{len(beyond)} of {len(shares)} cases in which auto is more than {BEHIND:.0%} behind "
            f"{name}; at most {max(0.0, *shares.values()):.1%}"
        )
        for told in beyond:
            print(f"  {told}: {shares[told]:.1%} behind")
