"""Fits that are advanced, compared bit for bit, and continued from checkpoints."""

from collections.abc import Callable
from pathlib import Path

import torch

from warpgs.pipeline.model.table import Table
from warpgs.pipeline.run.folder import load_checkpoint, save_checkpoint
from warpgs.pipeline.train.schedule import OptimizerConfig
from warpgs.pipeline.train.trainer import Trainer


def advanced(fit: Trainer, until: int | None = None) -> Trainer:
    while fit.step < (fit.steps if until is None else until):
        fit.advance((fit.steps if until is None else until) - fit.step)
    return fit


def same_bits(a: Trainer, b: Trainer, but: tuple[str, ...] = ()) -> bool:
    (mine, values), (theirs, others) = a.state(), b.state()
    equal = mine.keys() == theirs.keys() and all(torch.equal(t, theirs[n]) for n, t in mine.items() if n not in but)
    return equal and (bool(but) or values == others)


def continued(make: Callable[[], Trainer], at: int, folder: Path) -> Trainer:
    """A fit that was saved at a step, and continued to its end by another from the checkpoint."""
    save_checkpoint(folder, *advanced(make(), at).state())
    fit = make()
    fit.load(*load_checkpoint(folder))
    return advanced(fit)


def adam_step(table: Table, gradients: dict[str, torch.Tensor], step: int = 1, skip: int = 0) -> None:
    """Update all parameters from gradients by name, with the default learning rates at the start of a fit."""
    c = OptimizerConfig()
    lrs = torch.tensor(table.lr_row(c.lrs(0.0, 1.0), step, c.head_lrs), device=table.device)
    flag = torch.tensor([skip], dtype=torch.int32, device=table.device)
    table.adam_step({n: gradients[n] for n in table.params}, lrs, flag)
