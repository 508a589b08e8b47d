from __future__ import annotations

import support  # noqa: F401  (registers environments and a third-party method)
import torch as th

th.set_num_threads(1)
