"""Memory that a fit needs, as the sum of the needs that its parts declare, and the means to keep to a limit.

A step needs the memory of the parameters and Adam's state, plus the memory of its heaviest moment, such as blending or the
loss. Each part declares its bytes in the code beside its allocations. Kernels, loss terms, view modules and the strategy
declare bytes for each moment of a step (`StepSizes`); the table declares bytes for each row. The CUDA driver, Python and the
compiled kernels need additional memory. Small parts are not counted: parameters of single views, and the buffers of learning
rates and losses (`StepBuffers`).
"""

from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch

from warpgs.device import FLOAT, SAMPLING, StepSizes, add_needs, format_bytes
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
from warpgs.render.compose import inputs_of
from warpgs.render.options import RasterizeOptions, image_settings
from warpgs.scene import Camera, Gaussians

RENDER = (project.step_bytes, tiles.step_bytes, blend.step_bytes, training_views.step_bytes)
"""Functions that return the bytes of a part of every step, at each moment of the step."""


class Layout:
    """Parts of a fit that, together with the numbers of Gaussians and instances, determine the memory of a step."""

    def __init__(
        self, table: Table, views: Sequence[TrainingView], terms: Sequence[LossTerm] = (), strategy: Strategy | None = None,
        modules: Sequence[ViewModule] = (), *, kept: Sequence[TrainingView] = (), captured: bool = False, sums: int = 0,
        averaged: bool = False,
    ):  # fmt: skip
        """Find the sizes of steps, with ``kept`` views beside those that are trained on."""
        largest = max((v.camera for v in views), key=lambda c: c.width * c.height)
        self.table, self.sums, self.averaged, cuda = table, sums, averaged, table.device.type == "cuda"
        self.sizes = StepSizes(
            largest.width, largest.height, table.row_bytes, len(views), masked=any(v.mask is not None for v in views),
            cutout=any(v.alpha is not None for v in views), depth="depth" in outputs_of(terms), cuda=cuda,
        )  # fmt: skip
        """Sizes of every step, without the numbers of Gaussians and instances."""
        self.parts = (*(t.bytes for t in terms), *(m.bytes for m in modules), *(() if strategy is None else (strategy.bytes,)))
        """Functions that return the bytes of a part of a step, at each moment of the step."""
        self.view_bytes = training_views.view_bytes([*views, *kept])
        """Bytes of all views, including data kept beside them."""
        self.graphs = len({v.kind for v in views}) if cuda and captured else 0
        """CUDA graphs that exist at a time, one for each size of view; 0 if steps are not captured."""

    def held(self, count: int) -> int:
        """Return the bytes that persist between steps: parameters, their moments and sums, columns, sums over slots, views."""
        columns = sum(c.element_size() for c in self.table.columns.values())
        each = (3 + self.averaged) * self.table.row_bytes + columns + self.sums * (self.table.row_bytes + SUMMED * FLOAT)
        return each * count + self.view_bytes

    def moments(self, count: int, instances: int, chunked: bool) -> dict[str, int]:
        """Return the bytes in addition to `held` at each moment of a step that may be the heaviest."""
        sizes = replace(self.sizes, count=count, instances=instances, chunked=chunked)
        needs, own = add_needs((*RENDER, *self.parts), sizes), add_needs(self.parts, sizes)
        if SAMPLING not in own:  # no part samples
            del needs[SAMPLING]
        return needs

    def event(self, before: int, after: int) -> int:
        """Return the bytes in addition to ``held(after)`` while rows are added: they, one tensor twice, and indices."""
        added = min(2 * (after - before), after)  # a split replaces one row by two
        largest = max(t.element_size() * t[0].numel() for t in self.table.params.values())
        return self.table.row_bytes * added + largest * (before + after) + 8 * after

    def step(self, count: int, instances: int, chunked: bool = False, graphs: int | None = None) -> int:
        """Return the bytes at the heaviest moment of a step; each CUDA graph keeps memory of its own."""
        copies, count = max(1, self.graphs if graphs is None else graphs), self.table.room_for(count)
        return self.held(count) + copies * max(self.moments(count, instances, chunked).values())

    def smallest(self, count: int) -> int:
        """Return the bytes of the smallest step: a chunk of one tile, at most one instance a Gaussian, without graphs."""
        return max(self.step(count, count, chunked, graphs=0) for chunked in (False, True))

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
    return low + bisect_left(range(low + 1, high + 1), True, key=lambda n: not fits(n))


@torch.no_grad()
def most_instances(gaussians: Gaussians, cameras: list[Camera], options: RasterizeOptions) -> int:
    """Return the number of (Gaussian, tile) instances for the camera that has the most; cameras hold tensors."""
    counts = (project.project_inputs(inputs_of(gaussians, c), image_settings(c, 0, options))[1].sum() for c in cameras)
    return max(map(int, counts))


def plan(
    layout: Layout, *, count: int, instances: int, most: int, limit: int | None, available: int, capacity_factor: float = 1.0
) -> dict[str, Any]:
    """Plan a fit of ``count`` Gaussians and ``instances`` in the heaviest view, growing to ``most``, for metrics.json.

    If captured steps would exceed the limit, the layout is changed to steps without graphs. The result has the ``limit`` and
    the ``available`` memory of the device [bytes]; Gaussians and instances at the start; bytes of the first steps
    (``planned``), and whether they render in chunks (``chunked``); and the number of Gaussians that densification may reach
    (``cap``), bytes and chunks there, if each Gaussian then touches as many tiles as at the start.
    """
    cap, refused = max(most, count), False
    if limit is not None:
        smallest = layout.smallest(count)
        if not smallest <= limit:
            raise UsageError(
                f"--memory-limit {format_bytes(limit)} is less than the {format_bytes(smallest)} that the smallest step needs "
                f"with {count:,} Gaussians and {layout.sizes.width} x {layout.sizes.height} px; raise the limit, start with "
                "fewer points (--max-gaussians N), or --downscale the views"
            )
        cap = layout.largest_count(limit, count, cap)
        graphs = layout.step(cap, int(capacity_factor * instances / count * cap))
        refused = layout.graphs > 0 and max(graphs, layout.held(cap) + layout.event(cap // 2, cap)) > limit
        layout.graphs *= not refused

    def needed(at: int) -> tuple[int, bool]:
        there = int(instances / count * at * (capacity_factor if layout.graphs else 1))
        whole = layout.step(at, there)
        if limit is None or whole <= limit:
            return whole, False
        return layout.step(at, min(there, layout.most_instances(at, limit)), chunked=True), True

    (now, chunked), (then, chunked_then) = needed(count), needed(cap)
    return {
        "limit": limit, "available": available, "gaussians": count, "instances": instances, "planned": now, "cap": cap,
        "planned_at_cap": then, "lowered_from": most if cap < most else None, "chunked": chunked,
        "chunked_at_cap": chunked_then, "graph_refused": refused,
    }  # fmt: skip


def plan_summary(f: dict[str, Any]) -> str:
    """Return the result of `plan` as one line for the user."""
    chunks = (", in chunks" * f[kind] for kind in ("chunked", "chunked_at_cap"))
    text = f"memory: a step takes {format_bytes(f['planned'])} now{next(chunks)}"
    text += f", about {format_bytes(f['planned_at_cap'])} at {f['cap']:,} Gaussians{next(chunks)}"
    if f["limit"] is None:
        if f["planned_at_cap"] <= f["available"]:
            return Detail(text)
        return f"{text}; only {format_bytes(f['available'])} are free: set --memory-limit, or lower --max-gaussians"
    text += f"; limit {format_bytes(f['limit'])}"
    text += "" if f["lowered_from"] is None else f", so there will be at most {f['cap']:,} Gaussians, not {f['lowered_from']:,}"
    return f"{text}{', and steps run without a CUDA graph, which would need more' if f['graph_refused'] else ''}"
