"""Steps of several views: slots, ranks, and the mean of their gradients."""

import functools
from collections.abc import Callable, Mapping, Sequence
from itertools import accumulate
from typing import Any

import torch
from torch import Tensor

from warpgs.errors import UsageError
from warpgs.kernels.update import end_step
from warpgs.pipeline.train.step import StepBuffers, StepPlan, StepTaker, steps_at_once
from warpgs.pipeline.train.views import Kind
from warpgs.ranks import Ranks
from warpgs.scene import Tensors

# Sums over the views of a step (slots), in one order for any number of processes.
#
# float32 values are added in a fixed binary tree over the slots 0 to B - 1. The sum of n slots is the sum of the first
# p slots plus the sum of the others, with p the largest power of two below n. Each process sums the largest subtrees of
# its own slots. From the subtrees of all processes, each process then completes the same tree, with the same bits as a
# single process.

SUMMED = 2
"""Number of statistics of a Gaussian that are summed with the gradients of several views: sum of its gradients, and number of
renders."""
Works = list[Callable[[], Any]]
"""Functions that are called one after the other."""
Node = tuple[int, int]
"""Slots of a subtree: the first, and the last plus one."""
ALIGNMENT = 16
"""Alignment of the parts of a sum, in floats: Adam reads four at a time."""
FLOAT_BYTES = 4
"""Size of a float [bytes]."""
DIVIDED_BYTES = 2**26
"""Least size of a tensor whose rows are divided among processes [bytes]: the update of a smaller tensor takes less time than
the start of two more exchanges."""


def check_ranks(batch: int, ranks: Ranks) -> None:
    """Check that every process has a view in each step of ``batch`` views."""
    if batch < ranks.count:
        raise UsageError(f"--batch {batch} is below the {ranks.count} ranks; give a multiple of them, or start fewer ranks")


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


def finished(node: Node, known: Mapping[Node, Tensor]) -> Tensor:
    """Return the sum of a node from known sums of its subtrees, shape [...]; the known sums are overwritten."""
    if node in known:
        return known[node]
    left, right = (finished(child, known) for child in children(node))
    return left.add_(right)


class Tree:
    """The tree over the slots of a step, and the part that each process adds."""

    def __init__(self, batch: int, ranks: Ranks):
        """Divide ``batch`` slots among the processes."""
        self.batch, self.ranks = batch, ranks
        of_ranks = [own_slots(batch, ranks.count, rank) for rank in range(ranks.count)]
        self.slots = of_ranks[ranks.rank]
        """Slots of this process."""
        self.nodes = [subtrees(slots, (0, batch)) for slots in of_ranks]
        """Subtrees that each process sums."""
        self.width = max(map(len, self.nodes))
        """Largest number of subtrees that a process sums."""
        self.rows = max(self.width, *(k + depth(node) for nodes in self.nodes for k, node in enumerate(nodes)))
        """Number of sums that a process keeps side by side: partial sums, and at least one for each exchanged sum. It is the
        largest that any process needs, so that all plan the same memory and so the same limits."""
        exchanged = 0 if ranks.count == 1 else self.width + (self.width if self.width > 1 else 0)
        self.buffers = self.rows + exchanged
        """Total number of sums that a process keeps, including copies for the exchange."""


class SlotSums:
    """Sums of several tensors over slots; the tensors of a sum have fixed shapes and lie side by side in memory.

    The rows of a large tensor may be divided among processes. Each process gets the sums of its own rows, updates these rows,
    and sends the updated rows instead of sums.
    """

    def __init__(
        self, tree: Tree, shapes: Sequence[tuple[int, ...]], device: torch.device, *, means: int = 0, large: int | None = None
    ):
        """Allocate memory; sums of the first ``means`` tensors become means, and rows of tensor ``large`` may be divided."""
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

    def parts(self, row: int = 0) -> list[Tensor]:
        """Return the summed tensors of one row, each in its own shape [...]; they share the memory of the row."""
        sized = zip(self.starts, self.shapes, strict=True)
        return [self.rows[row, start : start + torch.Size(s).numel()].view(s) for start, s in sized]

    def add_up(self, slot: Callable[[int, list[Tensor], bool], None]) -> list[Tensor]:
        """Add the slots of all processes; every process gets the same sums of the tensors, in their shapes [...].

        ``slot`` is a function of a slot's number, the tensors of a sum, and a flag: True to add to them, False to overwrite
        them. Divided rows then hold the sum of this process's slots only, until `sum_own_rows` is called.
        """
        for row, node in enumerate(self.tree.nodes[self.tree.ranks.rank]):
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

    def share(self, tensor: Tensor) -> None:
        """Send this process's rows of a tensor [N, ...], contiguous and shaped like the large tensor, to all others."""
        self.tree.ranks.gather(tensor[self.own_rows].view(-1), tensor[: self.divided].view(-1))

    def _add_node(self, node: Node, row: int, slot: Callable[[int, list[Tensor], bool], None]) -> None:
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

    def _own_sums(self, place: slice) -> Tensor:
        """Finish the sums of this process's part of the numbers in ``place``; all parts have equal size, [S]."""
        tree, ranks = self.tree, self.tree.ranks
        sent = self.rows[: tree.width, place].view(tree.width, ranks.count, -1).transpose(0, 1).contiguous()
        received = ranks.to_each(sent)
        known = {node: received[r, k] for r, nodes in enumerate(tree.nodes) for k, node in enumerate(nodes)}
        own = finished((0, tree.batch), known)
        self._average(place.start + ranks.rank * len(own), own)
        return own

    def _average(self, start: int, sums: Tensor) -> None:
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


class BatchSteps(StepTaker):
    """Steps of B views each."""

    def __init__(self, *parts: Any, tree: Tree):
        """Begin without memory for sums; ``parts`` are those of `StepTaker`."""
        super().__init__(*parts)
        b = self.buffers
        self.tree, self.kept_sums = tree, tree.buffers
        self.slots = StepBuffers(b.device, 1, steps_at_once(tree.batch) * len(tree.slots))
        """Settings and results of this process's slots, step by step."""
        self.said = torch.zeros(FLAGS + tree.batch, device=b.device, dtype=torch.float32)
        """Sums of the slots' losses, errors and flags in the last step, or in the step that a slot stopped."""
        self.told_to_stop = False
        """True if this process was asked to stop; the next step tells all other processes."""
        self.sums: SlotSums | None = None
        """Means of gradients, and sums of statistics and of ``said``, with the shapes of the last step."""
        self.large = ""
        """Parameter whose rows the sums may divide among processes."""
        self._update: tuple[StepPlan, Works] | None = None
        self._lrs, self._settings = torch.zeros_like(b.lr_rows[0]), torch.zeros_like(b.setting_rows[0])
        self._going = torch.zeros(1, dtype=torch.bool, device=b.device)

    def clear(self) -> None:
        """Drop all graphs, because the tensors that they refer to have changed."""
        self._update = None
        super().clear()

    def take(self, places: list[tuple[Kind, int]], settings: Callable[[], Sequence[tuple[float, ...]]], plan: StepPlan) -> None:
        """Take the steps of `buffers`; places and settings are those of the slots of all processes, step by step."""
        slots, batch = self.tree.slots, self.tree.batch
        # in all processes, or one alone would go on without graphs
        if self.captured and self.strategy.context.max_instances is not None:
            for kind in dict.fromkeys(kind for kind, _ in places):
                self.capacity(kind, plan)
        own, rows = [i for i in range(len(places)) if i % batch in slots], settings()
        self.slots.load([places[i][1] for i in own], [[1.0]] * len(own), [rows[i] for i in own])
        works = self.works(self.view_gradients, [places[i][0] for i in own], self.slots, plan)
        update: Works = []
        for begin in range(0, len(own), len(slots)):  # a step each
            first = [self._contribution(begin, works)]  # the strategy's statistics determine the sums
            if not update:
                sums, update = self._prepared(*first[0], plan)

            def add(slot: int, parts: list[Tensor], adds: bool) -> None:
                place = begin + slot - slots.start  # noqa: B023
                self._add(slot, place, *(first.pop() if first else self._contribution(place, works)), parts, adds)  # noqa: B023

            sums.add_up(add)
            for work in update:
                work()
        if sums.divided:  # only the process that updates a row has its moments
            for moments in (self.table.exp_avg, self.table.exp_avg_sq):
                sums.share(moments[self.large])

    def _contribution(self, place: int, works: Works) -> tuple[list[Tensor], dict[str, Tensor]]:
        """Return the gradients and statistics of a view; ``place`` counts this process's slots of all steps."""
        self.slots.counter.fill_(place)
        self.slots.stop.zero_()
        gradients, statistics, *_ = works[place]()
        return gradients, statistics

    @torch.no_grad()
    def _add(
        self, slot: int, place: int, gradients: list[Tensor], statistics: Tensors, parts: list[Tensor], adds: bool
    ) -> None:
        """Add the contribution of a slot to the parts of a sum, or overwrite the parts; ``place`` as in `_contribution`."""
        said = parts[-1]
        if not adds:
            said.zero_()
        for part, value in zip(parts[:-1], (*gradients, *statistics.values()), strict=True):
            part.add_(value) if adds else part.copy_(value)
        said[:STOP] += self.slots.history[place]
        said[FLAGS + slot : FLAGS + slot + 1].copy_(self.slots.stop)
        if self.told_to_stop and slot == self.tree.slots.start:
            said[STOP : STOP + 1].fill_(1.0)

    def _prepared(self, gradients: list[Tensor], statistics: Tensors, plan: StepPlan) -> tuple[SlotSums, Works]:
        """Return sums, and the functions that update by them; their shapes are those of a view's contribution."""
        shapes = [*(tuple(t.shape) for t in (*gradients, *statistics.values())), (FLAGS + self.tree.batch,)]
        if self.sums is None or self.sums.shapes != shapes:
            self.sums = self._update = None
            params = self.table.params
            self.large = max(params, key=lambda n: params[n].numel())
            place = list(params).index(self.large)
            self.sums = SlotSums(self.tree, shapes, self.buffers.device, means=len(gradients), large=place)
        if self._update is None or self._update[0] != plan:
            parts, count = self.sums.parts(), len(gradients)
            functions = self._functions(plan, self.sums, parts[:count], dict(zip(statistics, parts[count:-1], strict=True)))
            if self.captured and self.cuda:  # all but the exchanges between processes
                functions = [f if k % 2 else self.capture(f, self.buffers).replay for k, f in enumerate(functions)]
            self._update = plan, functions
        return self.sums, self._update[1]

    def _functions(self, plan: StepPlan, sums: SlotSums, gradients: list[Tensor], statistics: Tensors) -> Works:
        """Return the functions of an update by sums; every second one is an exchange between processes."""
        b, lrs, divided = self.buffers, self._lrs, sums.divided

        def descend(names: list[str], rows: slice = slice(None)) -> None:
            self.descend(plan, gradients, lrs, b.stop, names, rows)

        @torch.no_grad()
        def common() -> None:
            """Check whether a slot stops the step; if not, count it; update what every process updates."""
            self.said.copy_(torch.where(b.stop == 0, sums.parts()[-1], self.said))
            b.stop.copy_(torch.maximum(b.stop, self.said[FLAGS:].max().int()))
            lrs.copy_(b.lr_rows.index_select(0, b.counter)[0])
            self._settings.copy_(b.setting_rows.index_select(0, b.counter)[0])
            loss, mse = self.said[:STOP] / self.tree.batch
            self._going.copy_(end_step(loss, mse, b.counter, b.stop, b.history))
            descend([n for n in self.table.params if not divided or n != self.large])
            if divided:
                descend([self.large], slice(divided, None))
            else:
                settle()

        @torch.no_grad()
        def settle() -> None:
            counted = {n: torch.where(self._going, t, 0) for n, t in statistics.items()}
            self.settle(plan, gradients, counted, self._settings, self._going)

        if not divided:
            return [common]
        share = functools.partial(sums.share, self.table.params[self.large].detach())
        return [common, sums.sum_own_rows, functools.partial(descend, [self.large], sums.own_rows), share, settle]

    def stopped_slot(self) -> int:
        """Return the first slot that stopped the last steps; 0 if none did."""
        flags = self.said[FLAGS:].tolist()
        return flags.index(max(flags))

    def agreed(self, stopped: bool) -> bool:
        """Return whether to end after the last step: a request reaches one process first, the others with the next steps."""
        if self.tree.ranks.count == 1:
            return stopped
        self.told_to_stop = stopped
        return float(self.said[STOP]) > 0
