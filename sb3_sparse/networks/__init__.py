"""Network architectures, independent of masks."""

from sb3_sparse.networks.impala import ImpalaCNN
from sb3_sparse.networks.nature import ScaledNatureCNN

__all__ = ["ImpalaCNN", "ScaledNatureCNN"]
