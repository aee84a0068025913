"""Training steps captured as CUDA graphs: one for each plan and kind of view, with a fixed capacity for instances."""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable, Mapping, Sequence

import torch

from warpgs.errors import ResourceError
from warpgs.kernels.step_buffers import NOT_FINITE
from warpgs.kernels.tiles import BYTES_PER_INSTANCE, MAX_INSTANCES
from warpgs.pipeline.train.step import Learned, Renderer, StepBuffers, StepPlan, captured_renderer, step
from warpgs.pipeline.train.views import Kind, ViewStack, current
from warpgs.render.compose import count_instances, inputs_of
from warpgs.render.options import RasterizeOptions, image_settings
from warpgs.runtime.cuda_graph import CapturedGraph, GraphMemory
from warpgs.runtime.device_memory import available_bytes
from warpgs.scene import Gaussians

CAPACITY_FACTOR = 1.3
"""Capacity of a captured step for instances, as a multiple of the largest number of any view at the time of capture."""
DEAD_BYTES = 2**30
"""Largest memory of unused graphs that is kept [bytes]. Freeing it takes milliseconds, in which the device waits."""


class OverLimitError(ResourceError):
    """A captured step would exceed the memory limit of the fit."""


class Capacities:
    """Capacities of captured steps for instances, by kind of view and plan."""

    def __init__(self, learned: Learned, options: RasterizeOptions):
        """Compute nothing yet.

        Args:
            learned: Tables that steps change.
            options: Rule, background [3] and antialiasing of the fit.
        """
        self.learned, self.options = learned, options
        self._known: dict[tuple[Hashable, StepPlan], int] = {}

    def clear(self) -> None:
        """Drop all capacities, because the Gaussians have changed."""
        self._known.clear()

    def of(
        self, kinds: Sequence[Kind], stacks: Mapping[Kind, ViewStack], plan: StepPlan, max_instances: int | None
    ) -> dict[Kind, int]:
        """Return the capacity for each kind, computed at its first use.

        Args:
            kinds: Kinds of views.
            stacks: Views by kind.
            plan: Fixed choices of the steps.
            max_instances: Largest capacity; None for no limit.

        Raises:
            OverLimitError: A capacity would be above ``max_instances``.
            ResourceError: The instances would not fit into memory.
        """
        self._known = {k: c for k, c in self._known.items() if k[1] == plan}
        found = {}
        for kind in dict.fromkeys(kinds):
            if (kind, plan) not in self._known:
                now = current(stacks[kind], self.learned.views)
                self._known[kind, plan] = instance_capacity(self.learned.table.gaussians, now, plan.degree, self.options)
            found[kind] = self._known[kind, plan]
            if max_instances is not None and found[kind] > max_instances:
                raise OverLimitError(
                    f"a captured step would need capacity for {found[kind]:,} instances, but the limit allows {max_instances:,}"
                )
        return found


class StepGraphs:
    """Captured steps, one for each plan and kind of view, captured at first use."""

    def __init__(
        self, learned: Learned, buffers: StepBuffers, options: RasterizeOptions,
        work: Callable[[Learned, ViewStack, StepBuffers, StepPlan, Renderer], object] = step,
    ):  # fmt: skip
        """Begin without captured steps.

        Args:
            learned: Tables and strategy that steps change.
            buffers: Settings and results of steps.
            options: Rule, background [3] and antialiasing of the fit.
            work: Function that is captured.
        """
        self.work = work
        self.learned, self.buffers, self.options = learned, buffers, options
        device = buffers.device
        self.stream = torch.cuda.Stream(device)
        """Stream of captures, always the same one, since torch reuses freed memory only on the stream that used it before."""
        self.memory = GraphMemory(device)
        """Account of the memory that torch keeps for deleted graphs."""
        self.capacities = Capacities(learned, options)
        """Capacities of the graphs."""
        self._graphs: dict[tuple[Hashable, StepPlan], CapturedGraph] = {}

    def clear(self) -> None:
        """Drop all graphs, because the tensors that they refer to have changed."""
        self._graphs.clear()
        self.capacities.clear()

    def capture_all(
        self, kinds: Sequence[Kind], stacks: Mapping[Kind, ViewStack], plan: StepPlan, max_instances: int | None
    ) -> list[CapturedGraph]:
        """Return a graph for each of several steps with the same plan; missing graphs are captured first.

        Args:
            kinds: Kind of each step's view.
            stacks: Views by kind.
            plan: Fixed choices of the steps.
            max_instances: Largest capacity for instances; None for no limit.

        Raises:
            OverLimitError: The capacity of a graph would be above ``max_instances``.
            ResourceError: The instances would not fit into memory.
        """
        self._graphs = {k: g for k, g in self._graphs.items() if k[1] == plan}
        for kind in dict.fromkeys(kinds):
            if (kind, plan) in self._graphs:
                continue
            capacity = self.capacities.of([kind], stacks, plan, max_instances)[kind]
            self.memory.give_back(0 if max_instances is not None else DEAD_BYTES)
            render = captured_renderer(self.options, capacity, self.buffers.stop)
            work = functools.partial(self.work, self.learned, stacks[kind], self.buffers, plan, render)
            self._graphs[kind, plan] = self.capture(work)
        return [self._graphs[kind, plan] for kind in kinds]

    def capture(self, work: Callable[[], object]) -> CapturedGraph:
        """Return the graph of a function that changes nothing if the stop flag is set."""
        buffers = self.buffers
        here, loaded = torch.cuda.current_stream(buffers.device), buffers.view_rows.clone()
        self.stream.wait_stream(here)
        with torch.cuda.stream(self.stream):
            # a first run loads kernels and fills caches, which is not allowed during a capture; it changes no parameter
            buffers.stop.fill_(NOT_FINITE)
            buffers.view_rows.zero_()
            work()
            buffers.stop.zero_()
            buffers.view_rows.copy_(loaded)
            self.stream.synchronize()
            captured = CapturedGraph(work, self.stream)
        here.wait_stream(self.stream)
        return captured


@torch.no_grad()
def instance_capacity(gaussians: Gaussians, views: ViewStack, degree: int, options: RasterizeOptions) -> int:
    """Return the capacity of a captured step for (Gaussian, tile) instances, over all views of a stack.

    Raises:
        ResourceError: The instances would not fit into memory.
    """
    counts = [count_instances(inputs_of(gaussians, c), image_settings(c, degree, options)) for c in views.cameras()]
    wanted = int(CAPACITY_FACTOR * int(torch.stack(counts).max())) + 1024
    budget = available_bytes(gaussians.means.device) * 4 // 5
    if wanted > MAX_INSTANCES or wanted * BYTES_PER_INSTANCE > budget:
        raise ResourceError(
            f"a step needs {wanted * BYTES_PER_INSTANCE / 2**30:.2f} GiB for {wanted:,} (Gaussian, tile) instances, but "
            f"{budget / 2**30:.2f} GiB may be used; fit smaller images with --downscale, or lower --max-gaussians"
        )
    return wanted
