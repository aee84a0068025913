"""A table of learned values: parameters, their Adam moments and named columns, one row per Gaussian or view.

A fit has a table of Gaussians. A second table has a row for each training view; it has no parameters unless view modules learn
some.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import torch

from warpgs.errors import DataError, UsageError
from warpgs.geometry import logit
from warpgs.kernels.adam import BETAS, adam_scheduled, scheduled_lrs
from warpgs.kernels.knn import morton_codes
from warpgs.scene import Gaussians


@dataclass(frozen=True)
class Column:
    """An additional value of each row, besides its parameters."""

    fill: float
    """Initial value of a row without a parent."""
    dtype: torch.dtype = torch.float32
    """Type of the values."""
    inherited: bool = True
    """True if a new row takes the value of its parent; else it starts with ``fill``."""


@dataclass(frozen=True)
class DensityUpdate:
    """A change of the set of Gaussians: rows that stay, rows that are overwritten, rows that are appended."""

    keep: torch.Tensor
    """Indices of the surviving rows in ascending order, int64, shape [S]."""
    added: Mapping[str, torch.Tensor] = field(default_factory=dict)
    """New rows of each parameter, shape [A, ...]; their moments start at zero. Empty if no row is added."""
    parents: torch.Tensor = field(default_factory=lambda: torch.empty(0, dtype=torch.int64, device="cpu"))
    """Index, before the change, of the parent of each new row, -1 without a parent, int64, shape [A]."""
    columns: Mapping[str, float] = field(default_factory=dict)
    """Initial values by column, by default the column's ``fill``. New rows take them if they have no parent, or if the column
    is not inherited."""
    overwritten: torch.Tensor | None = None
    """Indices, before the change, of the rows to overwrite: parameters are replaced, and moments restart at zero. Int64, shape
    [R]; None to overwrite no row."""
    values: Mapping[str, torch.Tensor] = field(default_factory=dict)
    """Parameters of the overwritten rows, shape [R, ...]; parameters left out are unchanged."""


class Table:
    """Parameters with their Adam moments, and columns; all of them have the same rows."""

    batch: int = 1
    """Number B of views over which gradients are averaged. Learning rates are multiplied by the square root of B, and decay
    rates of the moments are raised to the power B (Zhao et al. 2024, Grendel-GS, arXiv 2406.18533)."""

    def __init__(self, params: Mapping[str, torch.Tensor], columns: Mapping[str, Column], device: torch.device, count: int):
        """Begin with zero moments and filled columns.

        Args:
            params: Parameters by name, float32, shape [N, ...]; copied.
            columns: Columns by name.
            device: Device of the table.
            count: Number of rows N.
        """
        self.device = device
        self.params = {n: t.detach().clone().contiguous().requires_grad_() for n, t in params.items()}
        self.exp_avg = {n: torch.zeros_like(t) for n, t in self.params.items()}
        self.exp_avg_sq = {n: torch.zeros_like(t) for n, t in self.params.items()}
        self.kinds: dict[str, Column] = {}
        self.columns: dict[str, torch.Tensor] = {}
        self.count = count
        self.add_columns(columns)

    def add_columns(self, columns: Mapping[str, Column]) -> None:
        """Add columns by name, with their initial values."""
        self.kinds |= columns
        self.columns |= {n: torch.full((self.count,), c.fill, dtype=c.dtype, device=self.device) for n, c in columns.items()}

    def __len__(self) -> int:
        """Return the number of rows."""
        return self.count

    @staticmethod
    def of_gaussians(gaussians: Gaussians, columns: Mapping[str, Column]) -> Table:
        """Return the table of a set of Gaussians."""
        return Table(gaussians.tensors(), columns, gaussians.means.device, len(gaussians))

    @property
    def row_bytes(self) -> int:
        """Bytes of the parameters of a row."""
        return sum(t.element_size() * t[0].numel() for t in self.params.values())

    def lasting_bytes(self) -> int:
        """Return the bytes of a row that persist between steps: parameters, two moments and columns."""
        return 3 * self.row_bytes + sum(c.element_size() for c in self.columns.values())

    def growth_bytes(self, before: int, after: int) -> int:
        """Return the bytes needed to add rows: the new rows, one tensor before and after the change, and indices."""
        added = min(2 * (after - before), after)  # a split replaces one row by two
        largest = max(t.element_size() * t[0].numel() for t in self.params.values())
        return self.row_bytes * added + largest * (before + after) + 8 * after

    @property
    def gaussians(self) -> Gaussians:
        """The current parameters as Gaussians; they require gradients."""
        return Gaussians(**self.params)

    @property
    def betas(self) -> tuple[float, float]:
        """Decay rates of the two moments for a batch of views."""
        return BETAS[0] ** self.batch, BETAS[1] ** self.batch

    def lr_row(self, lrs: Mapping[str, float], step: int, head_lrs: Mapping[str, float]) -> list[float]:
        """Return the numbers for `adam_step` in a step, 3 for each parameter, in order.

        Args:
            lrs: Learning rate of each parameter, for steps of one view.
            step: Number of the step, from 1.
            head_lrs: Learning rate of the first 3 numbers of each row, for parameters whose first numbers have a rate of their
                own.
        """
        row, factor = [], math.sqrt(self.batch)
        for name in self.params:
            head = factor * head_lrs[name] if name in head_lrs else None
            row += scheduled_lrs(factor * lrs[name], step, self.betas, head)
        return row

    @torch.no_grad()
    def adam_step(
        self, gradients: Mapping[str, torch.Tensor], lrs: torch.Tensor, skip: torch.Tensor,
        factors: torch.Tensor | None = None, rows: slice = slice(None),
    ) -> None:  # fmt: skip
        """Update parameters with Adam, if ``skip`` [1] is 0.

        Args:
            gradients: Gradients of all or some parameters by name.
            lrs: A row of `lr_row`, float32, shape [3 P].
            skip: 0, or the reason for skipping the step, int32, shape [1].
            factors: Factor of the step of each mean, shape [N]; None for 1. Steps are scaled, not gradients, because Adam's
                step does not depend on the scale of the gradient.
            rows: Rows to update; with ``factors``, it must be all rows.
        """
        assert factors is None or rows == slice(None)
        before = None if factors is None else self.params["means"].detach().clone()
        for i, name in enumerate(self.params):
            if name not in gradients:
                continue
            state = (self.params[name].detach(), gradients[name], self.exp_avg[name], self.exp_avg_sq[name])
            of_rows = (t[rows] for t in state)
            adam_scheduled(*of_rows, lrs[3 * i : 3 * i + 3], skip, head=3 if name == "sh" else 0, betas=self.betas)
        if factors is not None:
            means = self.params["means"].detach()
            means.copy_(torch.where(factors[:, None] == 1, means, before + factors[:, None] * (means - before)))

    @torch.no_grad()
    def apply(self, update: DensityUpdate) -> None:
        """Apply a change of the set: kept rows keep everything, new rows start with zero moments.

        Raises:
            UsageError: A parameter is missing, or the numbers of new rows and parents differ.
        """
        none = {} if update.added or len(update.parents) else {n: t.detach()[:0] for n, t in self.params.items()}
        new_rows, keep, parents = none or update.added, update.keep, update.parents.to(self.device)
        rows = {n: len(new_rows[n]) if n in new_rows else None for n in self.params}
        if any(count != len(parents) for count in rows.values()):
            raise UsageError(
                f"a DensityUpdate has {len(parents)} parents but adds {rows} rows: each parameter needs one row for "
                "each entry of parents (-1 for a row without a parent)"
            )
        if update.overwritten is not None:
            self._overwrite(update.overwritten, update.values)
        for name in self.params:  # each old tensor is freed before the next is allocated
            added = new_rows[name].to(self.params[name].dtype)
            self.params[name] = torch.cat([self.params[name].detach()[keep], added]).requires_grad_()
            for moments in (self.exp_avg, self.exp_avg_sq):
                moments[name] = torch.cat([moments[name][keep], torch.zeros_like(added)])
        for name, kind in self.kinds.items():
            old = self.columns[name]
            new = old.new_full((len(parents),), update.columns.get(name, kind.fill))
            if kind.inherited and len(parents):
                new = torch.where(parents >= 0, old[parents.clamp_min(0)], new)
            self.columns[name] = torch.cat([old[keep], new])
        self.count = len(keep) + len(parents)

    def _overwrite(self, rows: torch.Tensor, values: Mapping[str, torch.Tensor]) -> None:
        for name, value in values.items():
            self.params[name].detach()[rows] = value.to(self.params[name].dtype)
        for moments in (self.exp_avg, self.exp_avg_sq):
            for t in moments.values():
                t[rows] = 0

    @torch.no_grad()
    def reorder(self, order: torch.Tensor) -> None:
        """Move row ``order[i]`` to row i; ``order`` is int64, shape [N]."""
        for group in (self.params, self.exp_avg, self.exp_avg_sq, self.columns):
            for name in group:
                group[name] = group[name].detach()[order]
        for param in self.params.values():
            param.requires_grad_()

    def sort_along_curve(self) -> None:
        """Put the Gaussians in Morton order, so that neighbours in space are neighbours in memory."""
        self.reorder(torch.argsort(morton_codes(self.params["means"].detach()), stable=True))

    def reset_opacities(self, opacity: float) -> None:
        """Limit every opacity to this value in (0, 1), and reset the moments of all opacities (the reset of 3DGS)."""
        limit = logit(opacity)  # in float64: the smallest float32 opacity would be 0
        self.params["logit_opacities"] = self.params["logit_opacities"].detach().clamp(max=limit).requires_grad_()
        self.exp_avg["logit_opacities"].zero_()
        self.exp_avg_sq["logit_opacities"].zero_()

    def _groups(self) -> dict[str, dict[str, torch.Tensor]]:
        return {"params": self.params, "exp_avg": self.exp_avg, "exp_avg_sq": self.exp_avg_sq, "columns": self.columns}

    def state(self) -> dict[str, torch.Tensor]:
        """Return all tensors by flat names, such as ``params.means``, for a checkpoint."""
        return {f"{group}.{n}": t.detach() for group, tensors in self._groups().items() for n, t in tensors.items()}

    def load(self, state: Mapping[str, torch.Tensor]) -> None:
        """Load what `state` returned.

        Raises:
            DataError: Columns or parameters are missing, unknown, or of the wrong shape or type.
        """
        own, stored = set(self.state()), {n for n in state if n.partition(".")[0] in self._groups()}
        if own != stored:
            raise DataError(
                f"the stored table has other columns or parameters: {', '.join(sorted(own ^ stored))}; continue with the "
                "code and the settings that the run was started with"
            )
        rows = {state[n].shape[:1] for n in stored}
        for name, own_tensor in self.state().items():
            t = state[name]
            if len(rows) > 1 or t.shape[1:] != own_tensor.shape[1:] or t.dtype != own_tensor.dtype:
                raise DataError(
                    f"the stored table is inconsistent: {name} has shape {list(t.shape)} and type {t.dtype}, expected "
                    f"[N, {', '.join(map(str, own_tensor.shape[1:]))}] and {own_tensor.dtype}, with one N for all tensors"
                )
        for group, tensors in self._groups().items():
            for name in tensors:
                tensors[name] = state[f"{group}.{name}"].to(self.device).contiguous()
        for t in self.params.values():
            t.requires_grad_()
        self.count = len(next(iter(self.params.values()))) if self.params else self.count
