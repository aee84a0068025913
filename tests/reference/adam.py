"""Adam as torch has it."""

import torch


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
