"""Memory that a fit needs, as the sum of the needs that its parts declare, and the means to keep to a limit.

A step needs the memory of the parameters and Adam's state, plus the memory of its heaviest moment, such as blending or the
loss. Each part declares its bytes in the code beside its allocations. Kernels, loss terms, view modules and the strategy
declare bytes for each moment of a step (`StepSizes`); the table declares bytes for each row. The CUDA driver, Python and the
compiled kernels need additional memory. Small parts are not counted: parameters of single views, and the buffers of learning
rates and losses (`StepBuffers`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch

from warpgs.device import FLOAT, SAMPLING, Needs, StepSizes, add_needs, format_bytes
from warpgs.errors import UsageError
from warpgs.kernels import blend, project, tiles
from warpgs.kernels.tiles import MAX_INSTANCES
from warpgs.pipeline.model.table import Table
from warpgs.pipeline.train import views as training_views
from warpgs.pipeline.train.batch import SUMMED
from warpgs.pipeline.train.loss import LossTerm, outputs_of
from warpgs.pipeline.train.strategies.base import Strategy
from warpgs.pipeline.train.view_modules import ViewModule
from warpgs.pipeline.train.views import TrainingView
from warpgs.process import Detail
from warpgs.render.compose import count_instances, inputs_of
from warpgs.render.options import RasterizeOptions, image_settings
from warpgs.scene import Camera, Gaussians

RENDER = (project.step_bytes, tiles.step_bytes, blend.step_bytes, training_views.step_bytes)
"""Functions that return the bytes of a part of every step, at each moment of the step."""


@dataclass(frozen=True)
class Layout:
    """Parts of a fit that, together with the numbers of Gaussians and instances, determine the memory of a step."""

    sizes: StepSizes
    """Sizes of every step, without the numbers of Gaussians and instances."""
    parts: tuple[Callable[[StepSizes], Needs], ...]
    """Functions that return the bytes of a part of a step, at each moment of the step."""
    table: Table
    """The Gaussians with their columns."""
    view_bytes: int
    """Bytes of all views, including data kept beside them."""
    graphs: int = 0
    """CUDA graphs that exist at a time, one for each size of view; 0 if steps are not captured."""
    sums: int = 0
    """Number of sums of gradients and statistics that a step of several views keeps (`warpgs.pipeline.train.batch`)."""
    averaged: bool = False
    """True if the parameters of the last steps are summed (`warpgs.pipeline.train.trainer`)."""

    def held(self, count: int) -> int:
        """Return the bytes that persist between steps: parameters, their moments and sums, columns, sums over slots, views."""
        sums = self.sums * (self.table.row_bytes + SUMMED * FLOAT) + self.averaged * self.table.row_bytes
        return (self.table.lasting_bytes() + sums) * count + self.view_bytes

    def moments(self, count: int, instances: int, chunked: bool) -> dict[str, int]:
        """Return the bytes in addition to `held` at each moment of a step that may be the heaviest."""
        sizes = replace(self.sizes, count=count, instances=instances, chunked=chunked)
        needs, own = add_needs((*RENDER, *self.parts), sizes), add_needs(self.parts, sizes)
        if SAMPLING not in own:  # no part samples
            del needs[SAMPLING]
        return needs

    def event(self, before: int, after: int) -> int:
        """Return the bytes in addition to ``held(after)`` while Gaussians are added."""
        return self.table.growth_bytes(before, after)

    def step(self, count: int, instances: int, chunked: bool = False) -> int:
        """Return the bytes at the heaviest moment of a step; each CUDA graph keeps memory of its own."""
        heaviest = max(1, self.graphs) * max(self.moments(count, instances, chunked).values())
        return self.held(count) + heaviest

    def smallest(self, count: int) -> int:
        """Return the bytes of the smallest step: a chunk of one tile, with at most one instance for each Gaussian."""
        return max(self.step(count, count, chunked) for chunked in (False, True))

    def most_instances(self, count: int, limit: int) -> int:
        """Return the largest number of instances, in an image or in a chunk of one, at which a step stays within a limit."""
        return _largest(1, MAX_INSTANCES, lambda n: max(self.step(count, n, chunked) for chunked in (False, True)) <= limit)

    def largest_count(self, limit: int, start: int, most: int) -> int:
        """Return the largest number of Gaussians, ``start`` to ``most``, with which steps and density events fit a limit."""

        def fits(count: int) -> bool:
            events = max(self.event(before, count) for before in (count // 2, count))
            return max(self.smallest(count), self.held(count) + events) <= limit

        return _largest(start, max(start, most), fits)


def _largest(low: int, high: int, fits: Callable[[int], bool]) -> int:
    """Return the largest number that fits, by bisection: all smaller numbers fit, too; ``low`` if none fits."""
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if fits(middle) else (low, middle - 1)
    return low


@dataclass(frozen=True)
class MemoryPlan:
    """Predicted memory of a fit, and the means by which it keeps to its limit."""

    limit: int | None
    """Bytes that the fit may take; None without a limit."""
    available: int
    """Bytes that the device had free."""
    gaussians: int
    """Number of Gaussians at the start."""
    instances: int
    """Largest number of (Gaussian, tile) instances of a view at the start."""
    planned: int
    """Bytes of the first steps."""
    cap: int
    """Number of Gaussians that densification may reach."""
    planned_at_cap: int
    """Bytes of steps at the cap, if each Gaussian then touches as many tiles as at the start."""
    lowered_from: int | None = None
    """Requested cap, if the limit lowered it; else None."""
    chunked: bool = False
    """True if the first steps render images in chunks."""
    chunked_at_cap: bool = False
    """True if steps at the cap render images in chunks."""
    graph_refused: bool = False
    """True if captured steps would exceed the limit, so that steps are not captured."""

    def to_json(self) -> dict[str, Any]:
        """Return plain values for metrics.json."""
        return asdict(self)

    def summary(self) -> str:
        """Return one line for the user."""
        text = f"memory: a step takes {format_bytes(self.planned)} now"
        if self.chunked:
            text += ", with the image in chunks"
        if self.cap > self.gaussians:
            about = "" if self.limit is not None else "about "
            text += f", {about}{format_bytes(self.planned_at_cap)} at {self.cap:,} Gaussians"
            if self.chunked_at_cap and not self.chunked:
                text += ", then in chunks"
        if self.limit is None:
            if self.planned_at_cap > self.available:
                fraction = (self.available - self.planned) / max(1, self.planned_at_cap - self.planned)
                reached = int(self.gaussians + max(0.0, fraction) * (self.cap - self.gaussians))
                text += f"; the free {format_bytes(self.available)} suffice for about {reached:,} Gaussians; set --memory-limit"
                return text
            return text if self.chunked else Detail(text)
        text += f"; limit {format_bytes(self.limit)}"
        if self.lowered_from is not None:
            text += f", so there will be at most {self.cap:,} Gaussians, not {self.lowered_from:,}"
        if self.graph_refused:
            text += ", and steps run without a CUDA graph, which would need more"
        return text


def layout_of(
    table: Table, views: Sequence[TrainingView], terms: Sequence[LossTerm] = (), strategy: Strategy | None = None,
    modules: Sequence[ViewModule] = (), *, kept: Sequence[TrainingView] = (), captured: bool = False, sums: int = 0,
    averaged: bool = False,
) -> Layout:  # fmt: skip
    """Return the layout of steps of a fit."""
    largest = max((v.camera for v in views), key=lambda c: c.width * c.height)
    cuda = table.device.type == "cuda"
    sizes = StepSizes(
        largest.width, largest.height, table.row_bytes, len(views), masked=any(v.mask is not None for v in views),
        cutout=any(v.alpha is not None for v in views), depth="depth" in outputs_of(terms), cuda=cuda,
    )  # fmt: skip
    parts = (*(t.bytes for t in terms), *(m.bytes for m in modules), *(() if strategy is None else (strategy.bytes,)))
    graphs = len({v.kind for v in views}) if cuda and captured else 0
    return Layout(sizes, parts, table, training_views.view_bytes([*views, *kept]), graphs, sums, averaged)


@torch.no_grad()
def most_instances(gaussians: Gaussians, cameras: list[Camera], options: RasterizeOptions) -> int:
    """Return the number of (Gaussian, tile) instances for the camera that has the most; cameras hold tensors."""
    return max(int(count_instances(inputs_of(gaussians, c), image_settings(c, 0, options))) for c in cameras)


def plan(
    layout: Layout, *, count: int, instances: int, most: int, limit: int | None, available: int, capacity_factor: float = 1.0
) -> tuple[MemoryPlan, Layout]:
    """Plan a fit of ``count`` Gaussians and ``instances`` in the heaviest view, growing to ``most``; return its layout, too."""
    cap, refused = max(most, count), False
    single = replace(layout, graphs=0)
    if limit is not None:
        if not single.smallest(count) <= limit:
            raise UsageError(
                f"--memory-limit {format_bytes(limit)} is less than the {format_bytes(single.smallest(count))} that the "
                f"smallest step needs with {count:,} Gaussians and {layout.sizes.width} x {layout.sizes.height} px; raise "
                "the limit, start with fewer points (--max-gaussians N), or --downscale the views"
            )
        cap = single.largest_count(limit, count, cap)
        graphs = layout.step(cap, int(capacity_factor * instances / count * cap))
        if layout.graphs and max(graphs, layout.held(cap) + layout.event(cap // 2, cap)) > limit:
            layout, refused = single, True

    def needed(at: int) -> tuple[int, bool]:
        there = int(instances / count * at * (capacity_factor if layout.graphs else 1))
        whole = layout.step(at, there)
        if limit is None or whole <= limit:
            return whole, False
        return layout.step(at, min(there, layout.most_instances(at, limit)), chunked=True), True

    (now, chunked), (then, chunked_then) = needed(count), needed(cap)
    lowered = most if cap < most else None
    made = MemoryPlan(limit, available, count, instances, now, cap, then, lowered, chunked, chunked_then, refused)
    return made, layout
