"""Steps of a fit: one by one, replayed as CUDA graphs, or with several views distributed over processes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from warpgs.pipeline.train.batch import BatchSteps
from warpgs.pipeline.train.slots import Tree
from warpgs.pipeline.train.step import Learned, StepBuffers, StepPlan, eager_renderer, step
from warpgs.pipeline.train.step_graphs import StepGraphs
from warpgs.pipeline.train.views import Kind, ViewStack
from warpgs.render.options import RasterizeOptions
from warpgs.runtime.ranks import Ranks


class StepTaker:
    """Steps of one fit."""

    def __init__(
        self, learned: Learned, buffers: StepBuffers, options: RasterizeOptions, batch: int, ranks: Ranks
    ):  # fmt: skip
        """Begin without captured steps.

        Args:
            learned: Tables and strategy that steps change.
            buffers: Settings and results of steps.
            options: Rule, background [3] and antialiasing of the fit.
            batch: Views of a step.
            ranks: Processes that share the views of a step.
        """
        self.learned, self.buffers, self.options, self.ranks = learned, buffers, options, ranks
        own = (learned, buffers, options)
        self.graphs = StepGraphs(*own) if buffers.device.type == "cuda" else None
        self.batched = BatchSteps(*own, Tree(batch, ranks)) if batch > 1 else None

    @property
    def sums(self) -> int:
        """Number of sums of gradients that a step of several views keeps."""
        return 0 if self.batched is None else self.batched.tree.buffers

    @property
    def stopped_slot(self) -> int:
        """First slot that stopped the last steps; 0 if none did, or in steps of one view."""
        return 0 if self.batched is None else self.batched.result()[0]

    def clear(self) -> None:
        """Drop all graphs; they are captured again."""
        for graphs in (self.graphs, self.batched):
            if graphs is not None:
                graphs.clear()

    def take(
        self, places: list[tuple[Kind, int]], settings: Callable[[], Sequence[tuple[float, ...]]],
        stacks: Mapping[Kind, ViewStack], plan: StepPlan, max_instances: int | None, *, captured: bool,
    ) -> None:  # fmt: skip
        """Take the steps whose learning rates and settings the buffers hold.

        Args:
            places: Kind and row of each step's view; in steps of several views, kind and row of each slot's view, step by step.
            settings: Returns the settings of each slot, step by step.
            stacks: Views by kind.
            plan: Fixed choices of the steps.
            max_instances: Largest number of (Gaussian, tile) instances of a view at a time; None for no limit.
            captured: Whether CUDA graphs are used.

        Raises:
            OverLimitError: The capacity of a graph would be above ``max_instances``; nothing was changed.
            ResourceError: The instances would not fit into memory, or another process is gone.
        """
        kinds = [kind for kind, _ in places]
        if self.batched is not None:
            self.batched.take(places, settings(), stacks, plan, max_instances, captured=captured)
        elif captured and self.graphs is not None:
            for graph in self.graphs.capture_all(kinds, stacks, plan, max_instances):
                graph.replay()
        else:
            render = eager_renderer(self.options, max_instances)
            for kind in kinds:
                step(self.learned, stacks[kind], self.buffers, plan, render)

    def agreed(self, stopped: bool) -> bool:
        """Return whether to end after the last step; all processes get the same answer.

        A request to stop reaches one process first, and the others with the next steps.
        """
        if self.batched is None or self.ranks.count == 1:
            return stopped
        self.batched.told_to_stop = stopped
        return self.batched.result()[1]
