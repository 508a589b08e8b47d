"""A task with dict observations, for ``--gym-packages dict_task``."""

import support  # noqa: F401, registers TinyDicts-v0
