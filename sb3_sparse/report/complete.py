"""Checks that a run's record is complete, and that the run is as sparse as its settings say."""

from __future__ import annotations

from sb3_sparse.errors import ConfigError
from sb3_sparse.zoo.record import NAME, Record, Status

NEAR = 0.01  # of the connections; rounding and schedules make far less of a difference


def check_complete(record: Record) -> None:
    """Check that a run has ended and that its record lacks nothing.

    :raises ConfigError: with the status or the missing part
    """
    if record.status is Status.FAILED:
        raise ConfigError(f"failed: {record.get('error') or 'no reason is recorded'}")
    if not record.status.is_over:
        raise ConfigError(f"not finished: its status is {str(record.status)!r}")
    for name in ("run", "settings", "total", "layers", "method"):
        if not record.get(name):
            raise ConfigError(f"{NAME} is incomplete: {name!r} is missing")
    needed = {"run": ("algo", "env_id", "seed"), "total": ("sparsity", "parameters", "flops")}
    for part, names in needed.items():
        for name in names:
            if not isinstance(record[part], dict) or record[part].get(name) is None:
                raise ConfigError(f"{NAME} is incomplete: {part}.{name} is missing")


def check_reached(record: Record) -> None:
    """Check that a run's networks are as sparse as its settings say.

    Older records lack ``wanted_nnz``; only runs with a denser start can have stayed too dense.

    :raises ConfigError: with the sparsity that it reached and the one that it should have reached
    """
    total, kwargs = record["total"], record.settings["policy_kwargs"]
    reached, asked = float(total["sparsity"]), kwargs.get("sparsity")
    wanted = total.get("wanted_nnz")
    if wanted is not None:
        missed = abs(int(total["nnz"]) - int(wanted)) > NEAR * int(wanted)
    else:
        denser = kwargs.get("initial_sparsity") is not None and isinstance(asked, (int, float))
        missed = denser and reached < asked - NEAR
    if missed:
        raise ConfigError(
            f"its sparsity is {reached:.2%}, not the {asked} that its settings ask for: it was not "
            "pruned, or not to the end; train it again with a callback that prunes, longer or with "
            "a smaller update_interval"
        )
