"""Sums over the views of a step (slots), in one order for any number of processes.

float32 values are added in a fixed binary tree over the slots 0 to B - 1. The sum of n slots is the sum of the first p slots
plus the sum of the others, with p the largest power of two below n. Each process sums the largest subtrees of its own slots.
From the subtrees of all processes, each process then completes the same tree, with the same bits as a single process.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate

import torch

from warpgs.errors import UsageError
from warpgs.runtime.ranks import Ranks

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
