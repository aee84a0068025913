"""The Gaussians of a fit with their statistics, and the model file that keeps them."""

import contextlib
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from warpgs import schema
from warpgs.errors import DataError, UsageError, expect, explained
from warpgs.files import read_tensors, tensor_pieces, write_bytes
from warpgs.geometry import check_stored, checked_normalization, convert_camera, convert_gaussians, logit
from warpgs.kernels.neighbours import morton_codes
from warpgs.kernels.sh import MAX_DEGREE
from warpgs.kernels.update import BETAS, adam_scheduled, scheduled_lrs
from warpgs.render.options import RasterizeOptions
from warpgs.scene import Camera, Gaussians, Normalization, Tensors
from warpgs.version import __version__

FLOAT = 4
"""Size of a stored number [bytes]."""
ROOM, LEAST_FILLED, MOST_WITH_ROOM = 1.25, 0.5, 2**20
"""Rows for which `Table.settle` takes memory, as a multiple of those in use; the fraction in use below which it takes less; and
the number in use above which it has no spare rows."""


def model_bytes(degrees: torch.Tensor) -> int:
    """Return the bytes of a model with these degrees [N]: float32, uncompressed, without coefficients above the degrees."""
    return FLOAT * int((11 + 3 * (degrees.long() + 1) ** 2).sum())


def truncated(sh: torch.Tensor, degrees: torch.Tensor) -> torch.Tensor:
    """Return coefficients [N, K, 3] with zeros above each Gaussian's degree [N], int."""
    bands = torch.arange(sh.shape[1], device=sh.device).add(0.5).sqrt().long()
    return torch.where((bands <= degrees[:, None])[..., None], sh, 0)


def pack(sh: torch.Tensor, degrees: torch.Tensor) -> torch.Tensor:
    """Pack coefficients [N, K, 3] up to each Gaussian's degree [N], which ascend, into one vector [M]."""
    expect((degrees.diff() >= 0).all(), "degrees must ascend; sort the Gaussians by degree first")
    return torch.cat([sh[degrees == d, : (d + 1) ** 2].reshape(-1) for d in range(MAX_DEGREE + 1)])


def unpack(packed: torch.Tensor, degrees: torch.Tensor) -> torch.Tensor:
    """Return coefficients [N, K, 3] from the vector [M] of `pack`: K for the highest degree, 0 above each Gaussian's degree."""
    whole = degrees.ndim == 1 and not degrees.is_floating_point() and bool(((degrees >= 0) & (degrees <= MAX_DEGREE)).all())
    fits = whole and packed.shape == (3 * int((degrees.long() + 1).square().sum()),)
    expect(fits, f"coefficients {list(packed.shape)} do not fit degrees {list(degrees.shape)}, 0 to {MAX_DEGREE}")
    highest = int(degrees.max()) if len(degrees) else 0
    sh, at = packed.new_zeros(len(degrees), (highest + 1) ** 2, 3), 0
    for d in range(highest + 1):
        block = sh[degrees == d, : (d + 1) ** 2]
        sh[degrees == d, : (d + 1) ** 2] = packed[at : at + block.numel()].view_as(block)
        at += block.numel()
    return sh


# A table of learned values: parameters, their Adam moments and named columns, one row per Gaussian or view.
#
# A fit has a table of Gaussians. A second table has a row for each training view; it has no parameters unless view
# modules learn some.


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
    """A change of the set of Gaussians: rows that stay, rows that are overwritten, rows that are appended; all are finite."""

    keep: torch.Tensor
    """Indices of the surviving rows in ascending order, int64, shape [S]."""
    added: Tensors = field(default_factory=dict)
    """New rows of each parameter, shape [A, ...]; their moments start at zero. Empty if no row is added."""
    parents: torch.Tensor = field(default_factory=lambda: torch.empty(0, dtype=torch.int64, device="cpu"))
    """Index, before the change, of the parent of each new row, -1 without a parent, int64, shape [A]."""
    columns: Mapping[str, float] = field(default_factory=dict)
    """Initial values by column, by default the column's ``fill``. New rows take them if they have no parent, or if the column
    is not inherited."""
    overwritten: torch.Tensor | None = None
    """Indices, before the change, of the rows to overwrite: parameters are replaced, and moments restart at zero. Int64, shape
    [R]; None to overwrite no row."""
    values: Tensors = field(default_factory=dict)
    """Parameters of the overwritten rows, shape [R, ...]; parameters left out are unchanged."""


class Table:
    """Parameters with their Adam moments, and columns; all of them have the same rows."""

    batch: int = 1
    """Number B of views over which gradients are averaged. Learning rates are multiplied by the square root of B, and decay
    rates of the moments are raised to the power B (Zhao et al. 2024, Grendel-GS, arXiv 2406.18533)."""
    settles: bool = False
    """True to keep addresses while the set of rows changes (`settle`), for CUDA graphs."""
    room: int = 0
    """Number of rows for which `settle` took memory."""

    def __init__(self, params: Tensors, columns: Mapping[str, Column], device: torch.device, count: int):
        """Begin with zero moments and filled columns.

        Args:
            params: Parameters by name, float32, shape [N, ...]; copied.
            columns: Columns by name.
            device: Device of the table.
            count: Number of rows N.
        """
        self.device = device
        self.params = {n: t.detach().clone().contiguous().requires_grad_() for n, t in params.items()}
        self.exp_avg, self.exp_avg_sq = ({n: torch.zeros_like(t) for n, t in self.params.items()} for _ in range(2))
        self.kinds: dict[str, Column] = {}
        self.columns: dict[str, torch.Tensor] = {}
        self.count = count
        self._memory: dict[tuple[str, str], torch.Tensor] = {}  # of `room` rows, by group and name
        self.add_columns(columns)

    def add_columns(self, columns: Mapping[str, Column]) -> None:
        """Add columns by name, with their initial values."""
        self.kinds |= columns
        self.columns |= {n: torch.full((self.count,), c.fill, dtype=c.dtype, device=self.device) for n, c in columns.items()}

    def __len__(self) -> int:
        """Return the number of rows."""
        return self.count

    @staticmethod
    def of_gaussians(gaussians: Gaussians, columns: Mapping[str, Column]) -> "Table":
        """Return the table of a set of Gaussians."""
        return Table(gaussians.tensors(), columns, gaussians.means.device, len(gaussians))

    @property
    def row_bytes(self) -> int:
        """Bytes of the parameters of a row."""
        return sum(t.element_size() * t[0].numel() for t in self.params.values())

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
            row += scheduled_lrs(factor * lrs[name], step, self.betas, factor * head_lrs[name] if name in head_lrs else None)
        return row

    @torch.no_grad()
    def adam_step(
        self, gradients: Tensors, lrs: torch.Tensor, skip: torch.Tensor,
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
    def apply(self, update: DensityUpdate, capacity: int | None = None) -> None:
        """Apply a change of the set: kept rows keep everything, new rows start with zero moments.

        Raises:
            UsageError: A parameter is missing or not finite, the numbers of new rows and parents differ, indices are wrong, or
                the set grows beyond ``capacity``.
        """
        self._check(update, capacity)
        if self.count > MOST_WITH_ROOM:  # else both sets would be held until `settle`
            self._memory = {}
        added, keep, parents = update.added, update.keep, update.parents.to(self.device)
        if not added and not len(parents):
            added = {n: t.detach()[:0] for n, t in self.params.items()}
        rows = {n: len(added[n]) if n in added else None for n in self.params}
        if any(count != len(parents) for count in rows.values()):
            raise UsageError(f"a DensityUpdate has {len(parents)} parents and {rows} rows: give each row a parent, -1 for none")
        if update.overwritten is not None:
            for name, value in update.values.items():
                self.params[name].detach()[update.overwritten] = value.to(self.params[name].dtype)
            for t in (*self.exp_avg.values(), *self.exp_avg_sq.values()):
                t[update.overwritten] = 0
        for name in self.params:  # each old tensor is freed before the next is allocated
            new = added[name].to(self.params[name].dtype)
            self.params[name] = torch.cat([self.params[name].detach()[keep], new]).requires_grad_()
            for moments in (self.exp_avg, self.exp_avg_sq):
                moments[name] = torch.cat([moments[name][keep], torch.zeros_like(new)])
        for name, kind in self.kinds.items():
            old = self.columns[name]
            new = old.new_full((len(parents),), update.columns.get(name, kind.fill))
            if kind.inherited and len(parents):
                new = torch.where(parents >= 0, old[parents.clamp_min(0)], new)
            self.columns[name] = torch.cat([old[keep], new])
        self.count = len(keep) + len(parents)

    def _check(self, update: DensityUpdate, capacity: int | None) -> None:
        """Check the indices and values of a change, and the size of the set after it."""
        rows_of = {"keep": (update.keep, 0), "overwritten": (update.overwritten, 0), "parents": (update.parents, -1)}
        with explained("a DensityUpdate is impossible", "correct the strategy that gave it", ValueError, UsageError):
            for name, (rows, low) in rows_of.items():
                if rows is None:
                    continue
                indices = isinstance(rows, torch.Tensor) and rows.dtype == torch.int64 and rows.ndim == 1
                expect(indices, f"{name} must be an int64 tensor of one axis, indices of rows")
                there = not len(rows) or low <= int(rows.min()) <= int(rows.max()) < self.count
                expect(there, f"{name} must be from {low} to {self.count - 1}, the rows before the change")
                expect(low or len(rows.unique()) == len(rows), f"{name} holds a row twice; copies go through added")
            for name, t in [*update.added.items(), *update.values.items()]:
                expect(torch.isfinite(t).all(), f"the rows of {name} have non-finite values")
        after = len(update.keep) + len(update.parents)
        if capacity is not None and after > max(capacity, self.count):
            raise UsageError(
                f"a DensityUpdate makes {after:,} Gaussians of {self.count:,}, but max_gaussians and the memory limit allow "
                f"{capacity:,}; add at most context.capacity - len(context.table), or raise --max-gaussians"
            )

    @torch.no_grad()
    def reorder(self, order: torch.Tensor) -> None:
        """Move row ``order[i]`` to row i; ``order`` is int64, shape [N]."""
        for group in self._groups().values():
            for name in group:
                group[name] = group[name].detach()[order]
        for param in self.params.values():
            param.requires_grad_()

    def sort_along_curve(self) -> None:
        """Put the Gaussians in Morton order, so that neighbours in space are neighbours in memory."""
        self.reorder(torch.argsort(morton_codes(self.params["means"].detach()), stable=True))

    def room_for(self, count: int) -> int:
        """Return the number of rows for which there is memory once ``count`` are in use."""
        return int(ROOM * count) if self.settles and count <= MOST_WITH_ROOM else count

    @torch.no_grad()
    def settle(self) -> bool:
        """Move the rows of Gaussians to fixed addresses, with spare rows behind them; return whether the addresses are new.

        They stay while the rows fit. Spare rows have opacity 0, so no step changes them. Only a table that `settles` is moved.
        """
        if not self.settles:
            self._memory, self.room = {}, 0
            return False
        new = not self._memory or not self.room >= self.count >= LEAST_FILLED * self.room
        memory, self._memory = self._memory, {}
        if new:
            self.room, memory = self.room_for(self.count), {}
        fills = {("columns", n): c.fill for n, c in self.kinds.items()} | {("params", "logit_opacities"): -math.inf}
        for group, tensors in self._groups().items():
            for name, rows in tensors.items():
                at = group, name
                whole = memory[at] = rows.new_empty(self.room, *rows.shape[1:]) if new else memory[at]
                if rows.data_ptr() != whole.data_ptr():  # the set changed
                    whole[: self.count] = rows
                    whole[self.count :] = fills.get(at, whole[:1] if group == "params" else 0)
                    tensors[name] = whole[: self.count].requires_grad_(group == "params")
        self._memory = memory
        return new

    @contextlib.contextmanager
    def with_spare_rows(self) -> Iterator[None]:
        """Count the spare rows of `settle`, if any, as rows within the block."""
        count = self.count
        try:
            self._show(self.room or count)
            yield
        finally:
            self._show(count)

    def _show(self, count: int) -> None:
        """Have the first ``count`` rows of the settled memory."""
        for (group, name), whole in self._memory.items():
            self._groups()[group][name] = whole[:count].requires_grad_(group == "params")
        self.count = count

    def reset_opacities(self, opacity: float) -> None:
        """Limit every opacity to this value in (0, 1), and reset the moments of all opacities (the reset of 3DGS)."""
        # the logit is float64: the smallest float32 opacity would be 0
        self.params["logit_opacities"] = self.params["logit_opacities"].detach().clamp(max=logit(opacity)).requires_grad_()
        for moments in (self.exp_avg, self.exp_avg_sq):
            moments["logit_opacities"].zero_()

    def _groups(self) -> dict[str, dict[str, torch.Tensor]]:
        return {"params": self.params, "exp_avg": self.exp_avg, "exp_avg_sq": self.exp_avg_sq, "columns": self.columns}

    def state(self) -> dict[str, torch.Tensor]:
        """Return all tensors by flat names, such as ``params.means``, for a checkpoint."""
        return {f"{group}.{n}": t.detach() for group, tensors in self._groups().items() for n, t in tensors.items()}

    def load(self, state: Tensors) -> None:
        """Load what `state` returned.

        Raises:
            DataError: Columns or parameters are missing, unknown, or of the wrong shape or type.
        """
        own = self.state()
        stored = {n: t for n, t in state.items() if n.partition(".")[0] in self._groups()}
        if own.keys() != stored.keys():
            others = ", ".join(sorted(own.keys() ^ stored.keys()))
            raise DataError(f"the stored table has other columns or parameters: {others}; continue with the run's own settings")
        same_rows = len({t.shape[:1] for t in stored.values()}) <= 1
        for name, t in stored.items():
            if not same_rows or t.shape[1:] != own[name].shape[1:] or t.dtype != own[name].dtype:
                wanted = f"[N, {', '.join(map(str, own[name].shape[1:]))}] and {own[name].dtype}, with one N for all tensors"
                raise DataError(f"the stored {name} has shape {list(t.shape)} and type {t.dtype}, expected {wanted}")
        for group, tensors in self._groups().items():
            for name in tensors:
                tensors[name] = stored[f"{group}.{name}"].to(self.device).contiguous()
        for t in self.params.values():
            t.requires_grad_()
        self.count = len(next(iter(self.params.values()))) if self.params else self.count


FORMAT = "warpgs-model-1"
_THREE = schema.items(schema.number(), 3)
_LEVEL = {"rotation": schema.items(_THREE, 3), "up": schema.or_null(_THREE), "place": schema.or_null(_THREE)}
SIMILARITY = schema.fields(
    {"offset": _THREE, "scale": schema.number(above=0)}, _LEVEL | {"unit": schema.one_of("units", "m")}, others=False
)
"""Schema of the values of a `Normalization` in files."""


def similarity_values(n: Normalization) -> dict[str, Any]:
    """Return the values of a normalization for JSON; only offset and scale if it was not levelled."""
    values = {name: v.tolist() if isinstance(v, np.ndarray) else v for name, v in (vars(n) | {"scale": float(n.scale)}).items()}
    return values if n.up is not None or n.unit != Normalization.unit else {name: values[name] for name in ("offset", "scale")}


def similarity_of(values: Mapping[str, Any], where: str) -> Normalization:
    """Return the normalization of `similarity_values`, which `SIMILARITY` has checked; DataError if it is no similarity."""
    arrays = {name: np.array(v, np.float64) if isinstance(v, list) else v for name, v in values.items()}
    return checked_normalization(Normalization(**arrays | {"scale": float(values["scale"])}), "file", where)


@dataclass(frozen=True)
class Model:
    """A set of Gaussians in scene units, with the conversion to file units."""

    scene_gaussians: Gaussians
    """The Gaussians in scene units [u]."""
    normalization: Normalization
    """Similarity from file to scene units."""

    def gaussians(self, units: str = "scene") -> Gaussians:
        """Return the Gaussians in ``scene`` units, as in a `Scene`, or in ``file`` units, as in the scene's files.

        Map coordinates in file units are float64.
        """
        return convert_gaussians(self.scene_gaussians, self.normalization, "scene", units)


@dataclass(frozen=True, repr=False)
class FittedModel(Model):
    """A model with the cameras it was fitted to and the settings it is rendered with."""

    scene_cameras: dict[str, Camera]
    """Cameras of all views of the scene by name, in scene units [u]."""
    train: tuple[str, ...]
    """Names of the views that were fitted."""
    test: tuple[str, ...]
    """Names of the views held out."""
    rule: str
    """Name of the rasterizer's cut-offs in the fit, such as exact."""
    background: tuple[float, float, float]
    """Colour behind the scene."""
    step: int
    """Steps done."""
    transparent: bool = field(default=False, kw_only=True)
    """True if the scene's images have an alpha channel, so that renders are transparent."""
    antialiased: bool = field(default=False, kw_only=True)
    """True if renders are antialiased (`RasterizeOptions.antialiased`)."""
    near: float | None = field(default=None, kw_only=True)
    """Nearest depth rendered [u] (`RasterizeOptions.near`); None for that of the rule."""

    def __repr__(self) -> str:
        """Describe the model in one line."""
        sizes = f"{len(self.scene_gaussians):,} Gaussians, {len(self.scene_cameras)} cameras"
        return f"<{type(self).__name__}: {sizes}, step {self.step}>"

    def cameras(self, units: str = "scene") -> dict[str, Camera]:
        """Return the cameras of all views by name, in ``scene`` or ``file`` units."""
        return {n: convert_camera(c, self.normalization, "scene", units) for n, c in self.scene_cameras.items()}

    def options(self) -> RasterizeOptions:
        """Return the rasterizer's options of the fit: rule, background and antialiasing."""
        background = self.scene_gaussians.means.new_tensor(self.background)
        return RasterizeOptions(rule=self.rule, background=background, antialiased=self.antialiased, near=self.near)


def save(path: str | Path, gaussians: Gaussians, normalization: Normalization | None = None, units: str = "scene") -> None:
    """Write a model to a safetensors file, atomically.

    Tensors are stored unchanged; the header contains their units and the normalization.

    Args:
        path: File to write; an existing file is replaced.
        gaussians: N Gaussians, on any device.
        normalization: Similarity from file to scene units; None for Gaussians in file units without a scene.
        units: Units of ``gaussians``: scene or file.

    Raises:
        DataError: A number is not finite, or the normalization is not a similarity.
        ResourceError: The file cannot be written.
        TypeError: The Gaussians have other parameters (``stored()`` of `ActivatedGaussians` converts them), or tensors differ
            in type.
        UsageError: The suffix is that of another format, the units are unknown, or scene units are given without a
            normalization.
        ValueError: The shapes of the tensors do not match.
    """
    where = f"{path}: not written"
    _check_values(gaussians, where)
    normalization = checked_normalization(normalization, units, where)
    similarity = {name: json.dumps(value) for name, value in similarity_values(normalization).items()}
    if (suffix := Path(path).suffix.lower()) in (".ply", ".spz", ".sog", ".splat", ".ksplat"):
        raise UsageError(f"{where}: this writes safetensors, not {suffix}; use warpgs.write_ply, or `warpgs export`")
    header = {"format": FORMAT, "version": __version__, "units": units} | similarity
    write_bytes(Path(path), *tensor_pieces(gaussians.tensors(), header))


def load(path: str | Path, device: str | torch.device = "cpu") -> Model:
    """Read a model that `save` wrote; `Model.gaussians` returns its Gaussians in scene or file units.

    Args:
        path: The file.
        device: Device of the tensors.

    Raises:
        DataError: The file is missing, damaged, or not a model.
    """
    path, fix = Path(path), "write it again with warpgs.save, or read PLY with warpgs.read_ply"
    tensors, header, _ = read_tensors(path, "check the path and its permissions", fix)
    if header.get("format") != FORMAT or tensors.keys() != Gaussians.__dataclass_fields__.keys():
        raise DataError(f"{path}: not a model of format {FORMAT}; {fix}")
    with explained(f"{path}: its header is damaged", fix, (KeyError, ValueError, UsageError)):
        units, names = header["units"], header.keys() - {"format", "version", "units"}
        SIMILARITY(similarity := {n: schema.parse(header[n]) for n in names}, "normalization")
        normalization = checked_normalization(similarity_of(similarity, str(path)), units, str(path))
    gaussians = checked_gaussians(tensors, str(path)).to(device)
    return Model(convert_gaussians(gaussians, normalization, units, "scene"), normalization)


def checked_gaussians(tensors: Tensors, where: str) -> Gaussians:
    """Return the tensors of a file as Gaussians; DataError that begins with ``where`` if they are not."""
    names = Gaussians.__dataclass_fields__
    if missing := [n for n in names if n not in tensors]:
        raise DataError(f"{where}: {', '.join(missing)} missing; restore the file, or write it again")
    gaussians = Gaussians(**{n: tensors[n] for n in names})
    with explained(f"{where}: damaged", "restore the file, or write it again", (TypeError, ValueError)):
        _check_values(gaussians, where)
    return gaussians


def _check_values(gaussians: Gaussians, where: str) -> None:
    """Check that stored Gaussians have matching shapes, one type, float32 or float64, and finite values."""
    check_stored(gaussians)
    for name, t in gaussians.tensors().items():
        if t.dtype not in (torch.float32, torch.float64) or t.dtype != gaussians.means.dtype:
            raise TypeError(f"{name} is {t.dtype}; give all tensors as float32 or all as float64")
    for name, t in gaussians.tensors().items():
        if not bool(torch.isfinite(t).all()):
            raise DataError(f"{where}: {name} holds non-finite values; use an earlier state of the model")
