"""The roughness of depth by whole maps, differentiable."""

import torch

from warpgs.kernels.roughness import BOUND, MIN_ALPHA


def roughness_reference(depth, alpha, rows, columns, weight, mask):
    """Map [H, W] of depth, opacity and weight [H, W], edges [H, W - 2] and [H - 2, W], and a mask [H, W] or None."""
    shown = ~(alpha <= MIN_ALPHA)
    shown = shown if mask is None else shown & (mask > 0)
    z, found = torch.where(shown, depth, 1), []
    for axis, edges in ((0, columns), (1, rows)):
        count = depth.shape[axis] - 2
        if count < 1:
            continue
        (a, b, c), (one, two, three) = ([t.narrow(axis, i, count) for i in range(3)] for t in (z, shown))
        rough = torch.where(one & two & three, (b / a + b / c - 2).abs(), 0)
        rough = rough.clamp_max(BOUND) * edges * weight.narrow(axis, 1, count)
        found.append(torch.nn.functional.pad(rough, (1, 1, 0, 0) if axis else (0, 0, 1, 1)))
    return sum(found, 0 * depth.detach().nan_to_num()) if found else 0 * depth
