"""One Adam step on a table of Gaussians, as a training step takes it."""

import torch

from warpgs.pipeline.model.table import Table
from warpgs.pipeline.train.schedule import OptimizerConfig


def adam_step(table: Table, gradients: dict[str, torch.Tensor], step: int = 1, skip: int = 0) -> None:
    """Update all parameters from gradients by name, with the default learning rates at the start of a fit."""
    c = OptimizerConfig()
    lrs = torch.tensor(table.lr_row(c.lrs(0.0, 1.0), step, c.head_lrs), device=table.device)
    flag = torch.tensor([skip], dtype=torch.int32, device=table.device)
    table.adam_step({n: gradients[n] for n in table.params}, lrs, flag)
