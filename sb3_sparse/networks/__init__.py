"""Network architectures, independent of masks."""

from sb3_sparse.networks.impala import ImpalaCNN
from sb3_sparse.networks.nature import ScaledNatureCNN
from sb3_sparse.networks.simba import SimbaBlock, simba

__all__ = ["ImpalaCNN", "ScaledNatureCNN", "SimbaBlock", "simba"]
