"""Sums over the views of a step, its slots, in one order for any number of processes.

Numbers of float32 are added in a fixed binary tree over the slots 0 to B - 1: slots ``first`` to ``end`` are those up to the
largest power of two below their number, plus the others. Each process sums the largest subtrees of its own slots. From the
subtrees of all processes, each then finishes the same tree, with the same bits as a single process.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise

import torch

from warpgs.errors import UsageError
from warpgs.runtime.ranks import Ranks

SUMMED = 2
"""Statistics of each Gaussian that are summed with the gradients of several views: sum of its gradients, number of renders."""
Node = tuple[int, int]
"""Slots of a subtree: the first, and the one behind the last."""
ALIGNMENT = 16
"""Alignment of the parts of a sum, in floats: Adam reads four at a time."""
PIECE_BYTES = 2**27
"""Size of a piece of a sum that processes exchange: its transfer takes many times as long as the start of an exchange."""
MAX_RENDERS = 2**24
"""Number of renders that a fit must stay below: it is a float32, from which each takes its random numbers."""


def check_ranks(batch: int, ranks: Ranks) -> None:
    """Check that every process has a view in each step of ``batch`` views.

    Raises:
        UsageError: There are fewer views than processes.
    """
    if batch < ranks.count:
        raise UsageError(
            f"--batch {batch} gives a step fewer views than the {ranks.count} ranks that share them; give --batch "
            f"{ranks.count} or a multiple of it, or start fewer ranks"
        )


def check_renders(batch: int, steps: int) -> None:
    """Check that the views of all ``steps``, each of ``batch`` views, can be numbered.

    Raises:
        UsageError: There are too many.
    """
    if batch > 1 and steps * batch >= MAX_RENDERS:
        raise UsageError(f"{steps:,} steps of {batch} views are more than {MAX_RENDERS:,} renders; lower --steps or --batch")


def children(node: Node) -> tuple[Node, Node]:
    """Return the two halves of a node of at least two slots."""
    first, end = node
    middle = first + (1 << (end - first - 1).bit_length() - 1)
    return (first, middle), (middle, end)


def own_slots(batch: int, ranks: int, rank: int) -> range:
    """Return the slots of one of several ranks: equally many each, or one more."""
    return range(rank * batch // ranks, (rank + 1) * batch // ranks)


def subtrees(slots: range, node: Node) -> list[Node]:
    """Return the largest nodes below a node that hold none but these slots, from the first slot to the last."""
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
    """Return the sum of a node from those that are known, shape [...]; they are overwritten."""
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
        """Most subtrees that a process sums."""
        return max(map(len, self.nodes))

    @property
    def rows(self) -> int:
        """Sums that a process keeps side by side: those that it adds up, one at least for each that is exchanged."""
        own = self.nodes[self.ranks.rank]
        return max(self.width, *(k + depth(node) for k, node in enumerate(own)))

    @property
    def buffers(self) -> int:
        """Sums that a process keeps in all, with copies for the exchange."""
        exchanged = 0 if self.ranks.count == 1 else self.width + (self.width if self.width > 1 else 0)
        return self.rows + exchanged


class SlotSums:
    """Sums over slots of tensors of fixed shapes, side by side in one piece of memory for each sum.

    Processes exchange a large tensor in pieces, so that the update by one piece overlaps with the exchange of the next: first
    all other tensors, then runs of its rows.
    """

    def __init__(self, tree: Tree, shapes: Sequence[tuple[int, ...]], device: torch.device, *, means: int = 0, large: int = 0):
        """Allocate.

        Args:
            tree: The tree.
            shapes: Shape of each tensor.
            device: Where sums are kept.
            means: Number of tensors, the first ones, whose sums become means over the slots.
            large: Number of the tensor that is exchanged in pieces if it is large.
        """
        self.tree, self.shapes, self.device = tree, [tuple(s) for s in shapes], device
        counts, unit = [torch.Size(s).numel() for s in self.shapes], ALIGNMENT * tree.ranks.count
        order = [*(k for k in range(len(counts)) if k != large), large]
        ends = accumulate(-(-counts[k] // ALIGNMENT) * ALIGNMENT for k in order)
        starts = dict(zip(order, [0, *ends], strict=False))
        starts[large] = -(-starts[large] // unit) * unit
        self.starts = [starts[k] for k in range(len(counts))]
        """Start of each tensor in a sum; the large one is the last."""
        self.rows = torch.zeros(tree.rows, starts[large] + -(-counts[large] // unit) * unit, device=device)
        """The sums, shape [R, L]."""
        self.means = [(self.starts[k], self.starts[k] + counts[k]) for k in range(means)]
        """Numbers of a sum that become means: the first of each tensor, and the one behind the last."""
        count = self.shapes[large][0]
        pieces = 1 if tree.ranks.count == 1 else max(1, round(counts[large] * self.rows.element_size() / PIECE_BYTES))
        step = -(-count // (pieces * unit)) * unit
        self.pieces = [slice(first, min(first + step, count)) for first in range(0, count, step)] if pieces > 1 else []
        """Rows of the large tensor in all pieces but the first; none where one piece holds everything."""
        inner = [starts[large] + piece.start * (counts[large] // count) for piece in self.pieces]
        self._bounds = [0, *inner, self.rows.shape[1]]
        self._side = torch.cuda.Stream(device) if device.type == "cuda" and tree.ranks.count > 1 else None

    def parts(self, row: int = 0) -> list[torch.Tensor]:
        """Return the tensors of a sum, parts of its memory, in their shapes [...]."""
        sized = zip(self.starts, self.shapes, strict=True)
        return [self.rows[row, start : start + torch.Size(s).numel()].view(s) for start, s in sized]

    def add_up(
        self, slot: Callable[[int, list[torch.Tensor], bool], None], arrived: Sequence[Callable[[], object]] = ()
    ) -> list[torch.Tensor]:
        """Add the slots of all processes; every process gets the same sums of the tensors, in their shapes [...].

        Args:
            slot: Function of a slot, the tensors of a sum, and whether it adds to them; else it overwrites them.
            arrived: Functions that are called in turn: the first once the first piece is complete, and so on.

        Raises:
            ResourceError: Another process is gone.
        """
        own = self.tree.nodes[self.tree.ranks.rank]
        for row, node in enumerate(own):
            self._add_node(node, row, slot)
        if self.tree.ranks.count == 1:
            self._average(0, self.rows[0])
            for work in arrived:
                work()
            return self.parts()
        if self._side is not None:
            self._side.wait_stream(torch.cuda.current_stream(self.device))
        for k, (first, end) in enumerate(pairwise(self._bounds)):
            with torch.cuda.stream(self._side):  # does nothing for None
                self._exchange(first, end)
            if self._side is not None:
                torch.cuda.current_stream(self.device).wait_stream(self._side)
            if arrived:
                arrived[k]()
        return self.parts()

    def _add_node(self, node: Node, row: int, slot: Callable[[int, list[torch.Tensor], bool], None]) -> None:
        """Add the slots of a node into a row, with those behind it as scratch."""
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

    def _average(self, start: int, sums: torch.Tensor) -> None:
        """Divide by the number of slots what becomes a mean among sums [S], which begin at ``start`` in a sum."""
        for first, end in self.means:
            sums[max(0, first - start) : max(0, end - start)].mul_(1 / self.tree.batch)

    def _exchange(self, first: int, end: int) -> None:
        """Finish the tree for a piece: each process adds one slice of it over all processes, and sends it to all."""
        tree, ranks = self.tree, self.tree.ranks
        count, width = ranks.count, tree.width
        sent = self.rows[:width, first:end].view(width, count, -1).transpose(0, 1).contiguous()
        received = ranks.to_each(sent)
        known = {node: received[r, k] for r, nodes in enumerate(tree.nodes) for k, node in enumerate(nodes)}
        own = finished((0, tree.batch), known)
        self._average(first + ranks.rank * len(own), own)
        ranks.gather(own, self.rows[0, first:end])
