"""A task's process: reads the task from its input, writes what came out to a file."""

from __future__ import annotations

import os
import pickle
import signal
import sys
import threading
import traceback
from pathlib import Path

from sb3_sparse.launch.base import Task


def main() -> None:
    """Do the task; stop as by SIGTERM when the process that started this one is gone."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # a KeyboardInterrupt, as Ctrl-C is
    packed = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_stop_at_the_end_of_input, daemon=True).start()
    value, error = None, None
    try:
        value = Task.unpacked(packed)()
    except (Exception, KeyboardInterrupt):
        error = traceback.format_exc()
        print(error, file=sys.stderr)
    answer = Path(sys.argv[1])
    new = answer.with_suffix(".new")
    new.write_bytes(pickle.dumps((value, error)))
    new.replace(answer)


def _stop_at_the_end_of_input() -> None:
    while os.read(sys.stdin.fileno(), 1):  # not the buffer, whose lock would be held at exit
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    main()
