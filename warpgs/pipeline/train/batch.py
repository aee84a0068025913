"""Steps of several views: each view has a slot for its gradients; these are averaged in a fixed order, for one update.

Slots are spread over the processes of a fit. Every process does the remaining work of a step, with the same bits.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence

import torch

from warpgs.kernels.step_buffers import NOT_FINITE, end_step
from warpgs.pipeline.train.slots import SlotSums, Tree
from warpgs.pipeline.train.step import (
    Learned,
    StepBuffers,
    StepGraphs,
    StepPlan,
    ViewGradients,
    eager_renderer,
    update,
    view_gradients,
)
from warpgs.pipeline.train.views import Kind, ViewStack
from warpgs.render.options import RasterizeOptions
from warpgs.runtime.cuda_graph import CapturedGraph

STOP, FLAGS = 2, 3
"""Positions in the last summed tensor, after loss and squared error: the number of processes that were asked to stop; and the
first of the slots' reasons to stop the step."""


def update_by_sums(
    learned: Learned, plan: StepPlan, parts: list[torch.Tensor], names: Sequence[str], buffers: StepBuffers, batch: int
) -> None:
    """Update all parameters and columns by sums over slots; nothing changes where a slot stops the step.

    Args:
        learned: Tables and strategy that the step changes.
        plan: Choices that the step is made of.
        parts: Sums of gradients, of statistics, and of the slots' reasons to stop, in their shapes [...]; the first become
            means.
        names: Names of the statistics.
        buffers: Settings of the step, and its result.
        batch: Number of slots B.
    """
    said, split = parts[-1], len(parts) - 1 - len(names)
    for gradient in parts[:split]:
        gradient.mul_(1 / batch)
    buffers.stop.copy_(said[FLAGS:].max())
    going = end_step(said[0] / batch, said[1] / batch, buffers.counter, buffers.stop, buffers.history)
    statistics = {n: torch.where(going, t, 0) for n, t in zip(names, parts[split:-1], strict=True)}
    found = ViewGradients(parts[:split], statistics, buffers.lr_rows[0], buffers.setting_rows[0], going)
    update(learned, plan, found, buffers.stop)


class BatchSteps:
    """Steps of B views each."""

    def __init__(self, learned: Learned, buffers: StepBuffers, options: RasterizeOptions, tree: Tree):
        """Begin without memory for sums.

        Args:
            learned: Tables and strategy that steps change.
            buffers: Settings and results of steps.
            options: Rule, background [3] and antialiasing of the fit.
            tree: The slots and their order.
        """
        self.learned, self.buffers, self.tree, self.options = learned, buffers, tree, options
        self.slots = StepBuffers(buffers.device, 1, len(tree.slots))
        """Settings and results of this process's slots."""
        self.told_to_stop = False
        """True if this process was asked to stop; the next step tells all others."""
        self.sums: SlotSums | None = None
        """Sums over slots, of the sizes of the last step."""
        self._graphs = self._updates = None
        if buffers.device.type == "cuda":
            self._graphs = StepGraphs(learned, self.slots, options, view_gradients)
            self._updates = StepGraphs(learned, buffers, options)
        self._update: tuple[StepPlan, CapturedGraph] | None = None

    def clear(self) -> None:
        """Drop all graphs, because the tensors that they refer to have changed."""
        self._update = None
        if self._graphs is not None:
            self._graphs.clear()

    def take(
        self, places: Sequence[tuple[Kind, int]], settings: Sequence[tuple[float, ...]], stacks: Mapping[Kind, ViewStack],
        plan: StepPlan, max_instances: int | None, *, captured: bool,
    ) -> None:  # fmt: skip
        """Take the step of `buffers`, with its learning rates and settings.

        Args:
            places: Kind and row of the view of each slot, of all processes.
            settings: Settings of each slot, as `StepBuffers` takes them.
            stacks: Views by kind.
            plan: Choices that the step is made of.
            max_instances: Instances that a view may have at a time; None for no limit.
            captured: Whether CUDA graphs are used.

        Raises:
            OverLimitError: The capacity of a graph would be above ``max_instances``; nothing was changed.
            ResourceError: The instances would not fit into memory, or another process is gone.
        """
        own = self.tree.slots
        self.slots.load([places[s][1] for s in own], [[1.0]] * len(own), [settings[s] for s in own])
        works = self._works([places[s][0] for s in own], stacks, plan, max_instances, captured)

        def found_in(slot: int) -> ViewGradients:
            self.slots.counter.fill_(slot - own.start)
            self.slots.stop.zero_()
            return works[slot - own.start]()

        first = [found_in(own.start)]  # the strategy's statistics determine the sums
        finish = self._finish(first[0], plan, captured)

        def add(slot: int, parts: list[torch.Tensor], adds: bool) -> None:
            self._add(slot, first.pop() if first else found_in(slot), parts, adds)

        assert self.sums is not None
        self.sums.add_up(add)
        finish()

    def _works(
        self, kinds: list[Kind], stacks: Mapping[Kind, ViewStack], plan: StepPlan, max_instances: int | None, captured: bool
    ) -> list[Callable[[], ViewGradients]]:
        """Return for each own slot, with a view of this kind, the function that finds its gradients."""
        if captured and self._graphs is not None:
            return [_replayed(graph) for graph in self._graphs.capture_all(kinds, stacks, plan, max_instances)]
        render = eager_renderer(self.options, max_instances)
        return [functools.partial(view_gradients, self.learned, stacks[k], self.slots, plan, render) for k in kinds]

    @torch.no_grad()
    def _add(self, slot: int, found: ViewGradients, parts: list[torch.Tensor], adds: bool) -> None:
        """Add what a slot contributes to the parts of a sum, or overwrite them by it."""
        said, place = parts[-1], slot - self.tree.slots.start
        if not adds:
            said.zero_()
        for part, value in zip(parts[:-1], (*found.gradients, *found.statistics.values()), strict=True):
            part.add_(value) if adds else part.copy_(value)
        said[:STOP] += self.slots.history[place]
        said[FLAGS + slot : FLAGS + slot + 1].copy_(self.slots.stop)
        if self.told_to_stop and place == 0:
            said[STOP : STOP + 1].fill_(1.0)

    def _finish(self, first: ViewGradients, plan: StepPlan, captured: bool) -> Callable[[], object]:
        """Return the function that updates by the sums, which are of what ``first`` contributes."""
        tensors = (*first.gradients, *first.statistics.values())
        shapes = [*(tuple(t.shape) for t in tensors), (FLAGS + self.tree.batch,)]
        if self.sums is None or self.sums.shapes != shapes:
            self.sums = self._update = None
            self.sums = SlotSums(self.tree, shapes, self.buffers.device)
        parts = self.sums.parts()
        work = functools.partial(
            update_by_sums, self.learned, plan, parts, tuple(first.statistics), self.buffers, self.tree.batch
        )
        if not captured or self._updates is None:
            return work
        if self._update is None or self._update[0] != plan:
            parts[-1].fill_(NOT_FINITE)  # runs before a capture change nothing
            self._update = (plan, self._updates.capture(work))
        return self._update[1].replay

    def result(self) -> tuple[int, bool]:
        """Return the first slot that stopped the step, 0 where none did, and whether a process was told to stop."""
        assert self.sums is not None
        said = self.sums.parts()[-1].tolist()
        return said.index(max(said[FLAGS:]), FLAGS) - FLAGS, said[STOP] > 0


def _replayed(graph: CapturedGraph) -> Callable[[], ViewGradients]:
    def work() -> ViewGradients:
        graph.replay()
        assert isinstance(graph.result, ViewGradients)
        return graph.result

    return work
