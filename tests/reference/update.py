"""Updates of a step in torch and numpy: Adam, dropout, the decay of opacities, captured steps."""

import numpy as np
import torch

# Adam as torch has it.


def adam_reference(param, grads, lr, betas=(0.9, 0.999), eps=1e-15):
    """The parameter after one step per gradient; ``lr`` may be a tensor of rates per element."""
    lrs = torch.as_tensor(lr, dtype=param.dtype).expand_as(param)
    result = param.clone()
    for lr in lrs.unique().tolist():
        chosen = lrs == lr
        leaf = param[chosen].clone().requires_grad_()
        optimizer = torch.optim.Adam([leaf], lr=lr, betas=betas, eps=eps)
        for g in grads:
            leaf.grad = g[chosen].clone()
            optimizer.step()
        result[chosen] = leaf.detach()
    return result


# Opacity dropout in numpy: the factors there are, and how often each occurs.


def expected_factors(p: float) -> tuple[np.ndarray, np.ndarray]:
    """The values a factor takes, and their probabilities; their mean is 1."""
    return np.array([0.0, 1 / (1 - p)]), np.array([p, 1 - p])


# Opacity decay in numpy and float64, by the opacities themselves.


def decayed(logits: np.ndarray, factor: float) -> np.ndarray:
    """Logits of the opacities of ``logits`` times a factor."""
    opacity = factor / (1 + np.exp(-logits.astype(float)))
    return np.log(opacity) - np.log1p(-opacity)


# The bookkeeping of a captured step, one torch operation after the other.


def begin_step(counter, view_rows, lr_rows, setting_rows, viewmats, Ks, targets):
    """Return what `warpgs.kernels.update.begin_step` returns."""
    view = view_rows.index_select(0, counter)
    lrs, settings = (t.index_select(0, counter)[0] for t in (lr_rows, setting_rows))
    return lrs, settings, viewmats.index_select(0, view), Ks.index_select(0, view), targets.index_select(0, view)[0]


def end_step(loss, mse, counter, stop, history):
    """Do what `warpgs.kernels.update.end_step` does."""
    history.index_copy_(0, counter, torch.stack([loss, mse])[None])
    stop.masked_fill_(~torch.isfinite(loss), 2)
    going = stop == 0
    counter += going
    return going


def squared_error(rgb, target):
    """Return what `warpgs.kernels.update.squared_error` returns."""
    return ((rgb.double().clamp(0, 1) - target.double()) ** 2).sum()
