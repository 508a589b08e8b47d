"""Measures sparse and dense agents: cost, gradients, robustness to noise, plasticity."""

from sb3_sparse.analysis.activity import (
    DormantShare,
    dormant_share,
    effective_rank,
    effective_ranks,
)
from sb3_sparse.analysis.flops import FlopsReport, LayerFlops, flops
from sb3_sparse.analysis.losses import Loss, register_losses
from sb3_sparse.analysis.plasticity import PlasticityCallback
from sb3_sparse.analysis.robustness import (
    NoiseRobustness,
    feature_std,
    noise_robustness,
    noisy_vec_env,
)
from sb3_sparse.analysis.snr import GradientSNR, GradientSNRCallback, NetworkSNR, gradient_snr

__all__ = [
    "DormantShare",
    "FlopsReport",
    "GradientSNR",
    "GradientSNRCallback",
    "LayerFlops",
    "Loss",
    "NetworkSNR",
    "NoiseRobustness",
    "PlasticityCallback",
    "dormant_share",
    "effective_rank",
    "effective_ranks",
    "feature_std",
    "flops",
    "gradient_snr",
    "noise_robustness",
    "noisy_vec_env",
    "register_losses",
]
