"""Steps of several views: slots, ranks, and the mean of their gradients."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate

import torch

from warpgs.errors import UsageError
from warpgs.kernels.graphs import CapturedGraph
from warpgs.kernels.update import end_step
from warpgs.pipeline.train.step import (
    Capacities,
    Learned,
    StepBuffers,
    StepGraphs,
    StepPlan,
    ViewGradients,
    descend,
    eager_renderer,
    settle,
    step,
    steps_at_once,
    view_gradients,
)
from warpgs.pipeline.train.views import Kind, ViewStack
from warpgs.ranks import Ranks
from warpgs.render.options import RasterizeOptions

# Sums over the views of a step (slots), in one order for any number of processes.
#
# float32 values are added in a fixed binary tree over the slots 0 to B - 1. The sum of n slots is the sum of the first
# p slots plus the sum of the others, with p the largest power of two below n. Each process sums the largest subtrees of
# its own slots. From the subtrees of all processes, each process then completes the same tree, with the same bits as a
# single process.

SUMMED = 2
"""Number of statistics of a Gaussian that are summed with the gradients of several views: sum of its gradients, and number of
renders."""
Node = tuple[int, int]
"""Slots of a subtree: the first, and the last plus one."""
ALIGNMENT = 16
"""Alignment of the parts of a sum, in floats: Adam reads four at a time."""
FLOAT_BYTES = 4
"""Size of a float [bytes]."""
DIVIDED_BYTES = 2**26
"""Least size of a tensor whose rows are divided among processes [bytes]: for a smaller tensor, the update takes less time than
the start of two more exchanges."""
MAX_RENDERS = 2**24
"""Upper bound of the number of renders of a fit: the random numbers of a render depend on its index, a float32."""


def check_ranks(batch: int, ranks: Ranks) -> None:
    """Check that every process has a view in each step of ``batch`` views.

    Raises:
        UsageError: A step has fewer views than processes.
    """
    if batch < ranks.count:
        raise UsageError(
            f"--batch {batch} is less than the number of ranks, {ranks.count}; give --batch {ranks.count} or a multiple "
            "of it, or start fewer ranks"
        )


def check_renders(batch: int, steps: int) -> None:
    """Check that the number of renders in ``steps`` of ``batch`` views is below `MAX_RENDERS`.

    Raises:
        UsageError: The number is too large.
    """
    if batch > 1 and steps * batch >= MAX_RENDERS:
        raise UsageError(f"{steps:,} steps of {batch} views are more than {MAX_RENDERS:,} renders; lower --steps or --batch")


def children(node: Node) -> tuple[Node, Node]:
    """Return the two halves of a node of at least two slots."""
    first, end = node
    middle = first + (1 << (end - first - 1).bit_length() - 1)
    return (first, middle), (middle, end)


def own_slots(batch: int, ranks: int, rank: int) -> range:
    """Return the slots of a rank; the numbers of slots of any two ranks differ by at most one."""
    return range(rank * batch // ranks, (rank + 1) * batch // ranks)


def subtrees(slots: range, node: Node) -> list[Node]:
    """Return the largest nodes below a node that contain only these slots, from the first slot to the last."""
    first, end = node
    if slots.start <= first and end <= slots.stop:
        return [node]
    if end <= slots.start or slots.stop <= first:
        return []
    return [found for child in children(node) for found in subtrees(slots, child)]


def depth(node: Node) -> int:
    """Return the number of partial sums in memory while the slots of a node are added one after the other."""
    first, end = node
    if end - first == 1:
        return 1
    left, right = children(node)
    return max(depth(left), (1 + depth(right)) if right[1] - right[0] > 1 else 1)


def finished(node: Node, known: Mapping[Node, torch.Tensor]) -> torch.Tensor:
    """Return the sum of a node from known sums of its subtrees, shape [...]; the known sums are overwritten."""
    if node in known:
        return known[node]
    left, right = (finished(child, known) for child in children(node))
    return left.add_(right)


@dataclass(frozen=True)
class Tree:
    """The tree over the slots of a step, and the part that each process adds."""

    batch: int
    """Number of slots B."""
    ranks: Ranks
    """The processes."""

    @property
    def slots(self) -> range:
        """Slots of this process."""
        return own_slots(self.batch, self.ranks.count, self.ranks.rank)

    @property
    def nodes(self) -> list[list[Node]]:
        """Subtrees that each process sums."""
        count, whole = self.ranks.count, (0, self.batch)
        return [subtrees(own_slots(self.batch, count, rank), whole) for rank in range(count)]

    @property
    def width(self) -> int:
        """Largest number of subtrees that a process sums."""
        return max(map(len, self.nodes))

    @property
    def rows(self) -> int:
        """Number of sums that a process keeps side by side: partial sums, and at least one for each exchanged sum.

        This is the largest number that any process needs, so that all processes plan the same memory and so the same limits.
        """
        return max(self.width, *(k + depth(node) for nodes in self.nodes for k, node in enumerate(nodes)))

    @property
    def buffers(self) -> int:
        """Total number of sums that a process keeps, including copies for the exchange."""
        exchanged = 0 if self.ranks.count == 1 else self.width + (self.width if self.width > 1 else 0)
        return self.rows + exchanged


class SlotSums:
    """Sums of several tensors over slots; the tensors of a sum have fixed shapes and lie side by side in memory.

    The rows of a large tensor may be divided among processes. Each process gets the sums of its own rows, updates these rows,
    and sends the updated rows instead of sums.
    """

    def __init__(
        self, tree: Tree, shapes: Sequence[tuple[int, ...]], device: torch.device, *, means: int = 0, large: int | None = None
    ):
        """Allocate memory for the sums.

        Args:
            tree: The tree.
            shapes: Shape of each tensor.
            device: Where sums are kept.
            means: Number of leading tensors whose sums become means over the slots.
            large: Index of the tensor whose rows are divided if it has at least `DIVIDED_BYTES`; None for no such tensor.
        """
        self.tree, self.shapes = tree, [tuple(s) for s in shapes]
        counts, unit = [torch.Size(s).numel() for s in self.shapes], ALIGNMENT * tree.ranks.count
        order = sorted(range(len(counts)), key=lambda k: k != large)
        ends = list(accumulate(-(-counts[k] // ALIGNMENT) * ALIGNMENT for k in order))
        starts = dict(zip(order, [0, *ends[:-1]], strict=True))
        self.starts = [starts[k] for k in range(len(counts))]
        """Offset of each tensor in a sum; the large tensor comes first."""
        self.divided = 0
        """Number of leading rows of the large tensor that are divided; the last few are treated like other tensors."""
        self._width = 1
        if large is not None and tree.ranks.count > 1 and FLOAT_BYTES * counts[large] >= DIVIDED_BYTES:
            rows = self.shapes[large][0]
            self.divided, self._width = rows // unit * unit, counts[large] // rows
        self.rows = torch.zeros(tree.rows, -(-ends[-1] // unit) * unit, device=device, dtype=torch.float32)
        """The sums, shape [R, L]."""
        self.means = [(self.starts[k], self.starts[k] + counts[k]) for k in range(means)]
        """Ranges of a sum that become means: for each tensor, the first entry and the one after the last."""

    @property
    def own_rows(self) -> slice:
        """Rows of the large tensor that this process sums and updates."""
        each = self.divided // self.tree.ranks.count
        return slice(self.tree.ranks.rank * each, (self.tree.ranks.rank + 1) * each)

    def parts(self, row: int = 0) -> list[torch.Tensor]:
        """Return the summed tensors of one row, each in its own shape [...]; they share the memory of the row."""
        sized = zip(self.starts, self.shapes, strict=True)
        return [self.rows[row, start : start + torch.Size(s).numel()].view(s) for start, s in sized]

    def add_up(self, slot: Callable[[int, list[torch.Tensor], bool], None]) -> list[torch.Tensor]:
        """Add the slots of all processes; every process gets the same sums of the tensors, in their shapes [...].

        Divided rows then hold the sum of this process's slots only, until `sum_own_rows` is called.

        Args:
            slot: Function of a slot's number, the tensors of a sum, and a flag: True to add to the tensors, False to overwrite
                them.

        Raises:
            ResourceError: Another process was lost.
        """
        own = self.tree.nodes[self.tree.ranks.rank]
        for row, node in enumerate(own):
            self._add_node(node, row, slot)
        if self.tree.ranks.count == 1:
            self._average(0, self.rows[0])
        else:
            place = slice(self.divided * self._width, self.rows.shape[1])
            self.tree.ranks.gather(self._own_sums(place), self.rows[0, place])
        return self.parts()

    def sum_own_rows(self) -> None:
        """Put sums over the slots of all processes into this process's rows of the large tensor."""
        own = self.own_rows
        sums = self._own_sums(slice(0, self.divided * self._width))
        self.rows[0, own.start * self._width : own.stop * self._width] = sums

    def share(self, tensor: torch.Tensor) -> None:
        """Send this process's rows of a tensor [N, ...], contiguous and shaped like the large tensor, to all others."""
        divided = tensor[: self.divided].view(-1)
        self.tree.ranks.gather(tensor[self.own_rows].view(-1), divided)

    def _add_node(self, node: Node, row: int, slot: Callable[[int, list[torch.Tensor], bool], None]) -> None:
        """Add the slots of a node into a row; the following rows are scratch memory."""
        if node[1] - node[0] == 1:
            slot(node[0], self.parts(row), False)
            return
        left, right = children(node)
        self._add_node(left, row, slot)
        if right[1] - right[0] == 1:
            slot(right[0], self.parts(row), True)
        else:
            self._add_node(right, row + 1, slot)
            self.rows[row].add_(self.rows[row + 1])

    def _own_sums(self, place: slice) -> torch.Tensor:
        """Finish the sums of this process's part of the numbers in ``place``; all parts have equal size, [S]."""
        tree, ranks = self.tree, self.tree.ranks
        sent = self.rows[: tree.width, place].view(tree.width, ranks.count, -1).transpose(0, 1).contiguous()
        received = ranks.to_each(sent)
        known = {node: received[r, k] for r, nodes in enumerate(tree.nodes) for k, node in enumerate(nodes)}
        own = finished((0, tree.batch), known)
        self._average(place.start + ranks.rank * len(own), own)
        return own

    def _average(self, start: int, sums: torch.Tensor) -> None:
        """Divide the means among sums [S] by the number of slots; ``start`` is the place of ``sums`` in a whole sum."""
        for first, end in self.means:
            sums[max(0, first - start) : max(0, end - start)].mul_(1 / self.tree.batch)


# Steps of several views: each view has a slot for its gradients; one update uses the mean over slots, in a fixed order.
#
# Slots are distributed over the processes of a fit. Every process does the rest of a step itself, with the same bits.
# On CUDA several steps are taken before their results are read, so that Python prepares a step while the device works
# on the previous one.

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
