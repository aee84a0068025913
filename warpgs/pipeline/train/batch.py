"""Steps of several views: each view has a slot for its gradients; one update uses the mean over slots, in a fixed order.

Slots are distributed over the processes of a fit. Every process does the rest of a step itself, with the same bits. On CUDA
several steps are taken before their results are read, so that Python prepares a step while the device works on the previous
one.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence

import torch

from warpgs.kernels.step_buffers import end_step
from warpgs.pipeline.train.slots import SlotSums, Tree
from warpgs.pipeline.train.step import (
    Learned,
    StepBuffers,
    StepPlan,
    ViewGradients,
    descend,
    eager_renderer,
    settle,
    steps_at_once,
    view_gradients,
)
from warpgs.pipeline.train.step_graphs import Capacities, StepGraphs
from warpgs.pipeline.train.views import Kind, ViewStack
from warpgs.render.options import RasterizeOptions
from warpgs.runtime.cuda_graph import CapturedGraph

STOP, FLAGS = 2, 3
"""Indices in the last summed tensor, which begins with loss and squared error: the number of processes that were asked to stop,
and the first slot's reason to stop the step."""


class SumUpdate:
    """The update of a step by sums over its slots."""

    def __init__(
        self, learned: Learned, plan: StepPlan, buffers: StepBuffers, sums: SlotSums, names: Sequence[str], large: str,
        said: torch.Tensor,
    ):  # fmt: skip
        """Keep the parts of the update.

        Args:
            learned: Tables and strategy that the step changes.
            plan: Fixed choices of the step.
            buffers: Settings of the steps, and their results.
            sums: Means of gradients, and sums of statistics and of the slots' losses and flags.
            names: Names of the statistics.
            large: Parameter whose rows the sums may divide among processes.
            said: Sums of losses and flags in the last step, or in the step that a slot stopped, [`FLAGS` + B]; written by the
                update.
        """
        self.learned, self.plan, self.buffers, self.sums, self.large, self.said = learned, plan, buffers, sums, large, said
        parts = sums.parts()
        self.gradients, self.statistics = parts[: -1 - len(names)], dict(zip(names, parts[-1 - len(names) : -1], strict=True))
        self.lrs, self.settings = torch.zeros_like(buffers.lr_rows[0]), torch.zeros_like(buffers.setting_rows[0])
        self.going = torch.zeros(1, dtype=torch.bool, device=buffers.device)

    def functions(self, captured: Callable[[Callable[[], object]], Callable[[], object]]) -> list[Callable[[], object]]:
        """Return the functions of the update in their order; ``captured`` converts a function, such as to a graph."""
        names = list(self.learned.table.params)
        if not self.sums.divided:
            return [captured(functools.partial(self._whole, names))]
        coefficients, sums = self.learned.table.params[self.large].detach(), self.sums
        return [
            captured(functools.partial(self._common, [n for n in names if n != self.large])),
            sums.sum_own_rows,
            captured(functools.partial(self._descend, [self.large], sums.own_rows)),
            functools.partial(sums.share, coefficients),
            captured(self._settle),
        ]

    @torch.no_grad()
    def _whole(self, names: list[str]) -> None:
        self._begin()
        self._descend(names)
        self._settle()

    @torch.no_grad()
    def _common(self, names: list[str]) -> None:
        """Update what every process updates: all rows of these parameters, and undivided rows of the large parameter."""
        self._begin()
        self._descend(names)
        self._descend([self.large], slice(self.sums.divided, None))

    @torch.no_grad()
    def _begin(self) -> None:
        """Check whether a slot stops the step; if not, count the step; load its settings."""
        b = self.buffers
        self.said.copy_(torch.where(b.stop == 0, self.sums.parts()[-1], self.said))
        b.stop.copy_(torch.maximum(b.stop, self.said[FLAGS:].max().int()))
        self.lrs.copy_(b.lr_rows.index_select(0, b.counter)[0])
        self.settings.copy_(b.setting_rows.index_select(0, b.counter)[0])
        loss, mse = self.said[:STOP] / self.sums.tree.batch
        self.going.copy_(end_step(loss, mse, b.counter, b.stop, b.history))

    def _descend(self, names: list[str], rows: slice = slice(None)) -> None:
        found = ViewGradients(self.gradients, {}, self.lrs, self.settings, self.going)
        descend(self.learned, self.plan, found, self.buffers.stop, names, rows)

    @torch.no_grad()
    def _settle(self) -> None:
        statistics = {n: torch.where(self.going, t, 0) for n, t in self.statistics.items()}
        settle(self.learned, self.plan, ViewGradients(self.gradients, statistics, self.lrs, self.settings, self.going))

    def complete(self) -> None:
        """Send all processes the moments of divided rows, which only the updating process has."""
        if self.sums.divided:
            for moments in (self.learned.table.exp_avg, self.learned.table.exp_avg_sq):
                self.sums.share(moments[self.large])


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
        self.slots = StepBuffers(buffers.device, 1, steps_at_once(tree.batch) * len(tree.slots))
        """Settings and results of this process's slots, step by step."""
        self.said = torch.zeros(FLAGS + tree.batch, device=buffers.device, dtype=torch.float32)
        """Sums of the slots' losses, errors and flags in the last step, or in the step that a slot stopped."""
        self.told_to_stop = False
        """True if this process was asked to stop; the next step tells all other processes."""
        self.sums: SlotSums | None = None
        """Sums over slots, with the shapes of the last step."""
        self._capacities = Capacities(learned, options)
        self._graphs = self._updates = None
        if buffers.device.type == "cuda":
            self._graphs = StepGraphs(learned, self.slots, options, view_gradients)
            self._graphs.capacities = self._capacities  # a kind that is captured later keeps the capacity that all agreed on
            self._updates = StepGraphs(learned, buffers, options)
        self._update: tuple[SumUpdate, list[Callable[[], object]]] | None = None

    def clear(self) -> None:
        """Drop all graphs, because the tensors that they refer to have changed."""
        self._update = None
        self._capacities.clear()
        if self._graphs is not None:
            self._graphs.clear()

    def take(
        self, places: Sequence[tuple[Kind, int]], settings: Sequence[tuple[float, ...]], stacks: Mapping[Kind, ViewStack],
        plan: StepPlan, max_instances: int | None, *, captured: bool,
    ) -> None:  # fmt: skip
        """Take the steps of `buffers`, with their learning rates and settings.

        Args:
            places: Kind and row of each slot's view, for the slots of all processes, step by step.
            settings: Settings of each slot, as `StepBuffers` takes them.
            stacks: Views by kind.
            plan: Fixed choices of the steps.
            max_instances: Largest number of (Gaussian, tile) instances of a view at a time; None for no limit.
            captured: Whether CUDA graphs are used.

        Raises:
            OverLimitError: The capacity of a graph would be above ``max_instances``; nothing was changed.
            ResourceError: The instances would not fit into memory, or another process is gone.
        """
        slots, batch = self.tree.slots, self.tree.batch
        if captured and max_instances is not None:  # in all processes, or one alone would go on without graphs
            self._capacities.of([kind for kind, _ in places], stacks, plan, max_instances)
        own = [i for i in range(len(places)) if i % batch in slots]
        self.slots.load([places[i][1] for i in own], [[1.0]] * len(own), [settings[i] for i in own])
        works = self._works([places[i][0] for i in own], stacks, plan, max_instances, captured)
        update: list[Callable[[], object]] = []
        for begin in range(0, len(own), len(slots)):  # a step each
            first = [self._found(begin, works)]  # the strategy's statistics determine the sums
            update = update or self._prepared(first[0], plan, captured)

            def add(slot: int, parts: list[torch.Tensor], adds: bool) -> None:
                place = begin + slot - slots.start  # noqa: B023
                found = first.pop() if first else self._found(place, works)  # noqa: B023
                self._add(slot, place, found, parts, adds)

            assert self.sums is not None
            self.sums.add_up(add)
            for work in update:
                work()
        assert self._update is not None
        self._update[0].complete()

    def _found(self, place: int, works: Sequence[Callable[[], ViewGradients]]) -> ViewGradients:
        """Return the contribution of a view; ``place`` counts this process's slots of all steps."""
        self.slots.counter.fill_(place)
        self.slots.stop.zero_()
        return works[place]()

    def _works(
        self, kinds: list[Kind], stacks: Mapping[Kind, ViewStack], plan: StepPlan, max_instances: int | None, captured: bool
    ) -> list[Callable[[], ViewGradients]]:
        """Return each slot's function for its gradients; ``kinds`` lists the kinds of view for this process's slots."""
        if captured and self._graphs is not None:
            return [_replayed(graph) for graph in self._graphs.capture_all(kinds, stacks, plan, max_instances)]
        render = eager_renderer(self.options, max_instances)
        return [functools.partial(view_gradients, self.learned, stacks[k], self.slots, plan, render) for k in kinds]

    @torch.no_grad()
    def _add(self, slot: int, place: int, found: ViewGradients, parts: list[torch.Tensor], adds: bool) -> None:
        """Add the contribution of a slot to the parts of a sum, or overwrite the parts; ``place`` is as in `_found`."""
        said = parts[-1]
        if not adds:
            said.zero_()
        for part, value in zip(parts[:-1], (*found.gradients, *found.statistics.values()), strict=True):
            part.add_(value) if adds else part.copy_(value)
        said[:STOP] += self.slots.history[place]
        said[FLAGS + slot : FLAGS + slot + 1].copy_(self.slots.stop)
        if self.told_to_stop and slot == self.tree.slots.start:
            said[STOP : STOP + 1].fill_(1.0)

    def _prepared(self, first: ViewGradients, plan: StepPlan, captured: bool) -> list[Callable[[], object]]:
        """Return the functions that update by the sums; ``first`` determines the shapes of the sums."""
        table, tensors = self.learned.table, (*first.gradients, *first.statistics.values())
        shapes = [*(tuple(t.shape) for t in tensors), (FLAGS + self.tree.batch,)]
        large = max(table.params, key=lambda n: table.params[n].numel())
        if self.sums is None or self.sums.shapes != shapes:
            self.sums = self._update = None
            place = list(table.params).index(large)
            self.sums = SlotSums(self.tree, shapes, self.buffers.device, means=len(first.gradients), large=place)
        if self._update is None or self._update[0].plan != plan:
            update, graphs = (
                SumUpdate(self.learned, plan, self.buffers, self.sums, tuple(first.statistics), large, self.said),
                self._updates,
            )
            if captured and graphs is not None:
                self._update = (update, update.functions(lambda work: graphs.capture(work).replay))
            else:
                self._update = (update, update.functions(lambda work: work))
        return self._update[1]

    def result(self) -> tuple[int, bool]:
        """Return the first slot that stopped the steps (0 if none did), and whether a process was asked to stop."""
        said = self.said.tolist()
        return said.index(max(said[FLAGS:]), FLAGS) - FLAGS, said[STOP] > 0


def _replayed(graph: CapturedGraph) -> Callable[[], ViewGradients]:
    def work() -> ViewGradients:
        graph.replay()
        assert isinstance(graph.result, ViewGradients)
        return graph.result

    return work
