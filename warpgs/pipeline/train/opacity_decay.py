"""Decay of opacities: each step lowers every opacity by a fraction, so that Gaussians without support in the photographs fade.

The idea comes from Binocular3DGS (Han et al. 2024, arXiv 2410.18822); docs/decisions/023-opacity-decay.md has measurements.
"""

from __future__ import annotations

import torch

from warpgs.kernels.opacity_decay import opacity_decay

LEAST_LOGIT = -15.0
"""Logit below which no opacity decays further, far below the pruning threshold."""


@torch.no_grad()
def decay_opacities(logits: torch.Tensor, fraction: float, going: torch.Tensor, used: torch.Tensor | None = None) -> None:
    """Lower every opacity by a fraction, in place; the call may be part of a captured step.

    Args:
        logits: Logits of opacities, float32, shape [N].
        fraction: Fraction by which an opacity is lowered, in [0, 1); 0 changes nothing.
        going: Whether the step is taken, bool, shape [1]; if False, nothing changes.
        used: Gaussians whose opacities change, bool, shape [N]; None for all.
    """
    kept = 1 - fraction
    if kept == 1:  # also a fraction below the rounding of float64
        return
    new = torch.where(logits > LEAST_LOGIT, opacity_decay(logits, kept), logits)
    logits.copy_(torch.where(going if used is None else going & used, new, logits))
