"""The bookkeeping of a captured step, one torch operation after the other."""

import torch


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
