"""What a fit needs of its device's memory, from the layouts that the kernels allocate, and how it keeps to a limit.

A step holds parameters with their moments throughout, and on top of them what its heaviest moment needs. Counted are the
tensors of the fit while it takes steps; what the CUDA driver, Python and the compiled kernels occupy comes on top.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace

import torch

from warpgs.constants import RULES
from warpgs.errors import UsageError
from warpgs.kernels import blend, blend_cuda
from warpgs.kernels.project import PROJECTED_SIZE, project
from warpgs.kernels.tiles import LIST_BYTES, MAX_INSTANCES, grid
from warpgs.runtime.byte_units import format_bytes
from warpgs.scene import Camera, Gaussians

FLOAT = 4
"""Bytes of a float32 or int32."""
SAMPLED = 8
"""Views that a sampling event looks at, at most (method.MAX_VIEWS)."""
TILE = 16
"""Side of a tile in a fit [px]."""


def instance_bytes(cuda: bool, tiles: int) -> tuple[int, int]:
    """Bytes of a (Gaussian, tile) instance in a picture of so many tiles: while lists are made, and in the backward pass.

    The backward pass has the lists without the owners, the gradient slots and, on CUDA, the states that blending left.
    """
    kept = LIST_BYTES - FLOAT
    if not cuda:
        return LIST_BYTES, kept + FLOAT * blend.VALUES
    chunk = blend_cuda.CHUNKS[int(tiles > blend_cuda.MAX_SMALL_TILES)]
    return LIST_BYTES, kept + FLOAT * blend_cuda.STRIDE + FLOAT * blend_cuda.STATE * TILE * TILE // chunk


@dataclass(frozen=True)
class Layout:
    """Everything but the number of Gaussians and instances that decides what a step needs."""

    coefficients: int
    """Spherical-harmonics coefficients a channel, K."""
    width: int
    """Of the largest view [px]."""
    height: int
    """Of the largest view [px]."""
    view_pixels: int
    """Of all views together."""
    views: int = 1
    """Number of views."""
    masked: bool = False
    """Whether a view has a mask."""
    scored: bool = False
    """Whether views have scores, by which fine Gaussians are sampled."""
    depth_supervised: bool = False
    """Whether the loss has its depth term."""
    cuda: bool = False
    recordings: int = 0
    """CUDA graphs that exist at a time, one for each size of view; 0 where steps are taken one by one."""

    @property
    def row(self) -> int:
        """Bytes of a Gaussian's parameters."""
        return FLOAT * (3 + 4 + 3 + 1 + 3 * self.coefficients)

    def held(self, count: int) -> int:
        """Bytes that last from step to step: parameters, two moments, density statistics, layers and births, views."""
        copies = 2 if self.recordings else 1  # recorded steps take views from one tensor
        views = FLOAT * (copies * (3 + self.masked + self.depth_supervised) + 3 * self.scored) * self.view_pixels
        return (3 * self.row + 4 * FLOAT) * count + views

    def moments(self, count: int, instances: int, banded: bool) -> dict[str, int]:
        """Bytes on top of `held` at each moment of a step that may be its heaviest.

        ``instances`` is the number in the picture or, if ``banded``, in its heaviest band.
        """
        pixels = self.width * self.height
        columns, rows = grid(self.width, self.height, TILE)
        listing, backward = (b * instances for b in instance_bytes(self.cuda, 0 if banded else columns * rows))
        waiting = backward - FLOAT * (blend_cuda.STRIDE if self.cuda else blend.VALUES) * instances
        record = FLOAT * PROJECTED_SIZE * count
        records = record + FLOAT * count  # with the tile counts
        ranges = 8 * columns * rows + 2 * FLOAT * count
        sorting = count * (FLOAT * 4 + 2 * 8)  # depths and order twice, two running sums
        images = 5 * FLOAT * pixels  # colour, alpha, depth
        kept = 3 * FLOAT * pixels  # transmittance, weight, end: what blending leaves for its gradient
        upstream = FLOAT * pixels * (3 if self.cuda and not self.depth_supervised else 5)
        # three partials for each colour and the gradient; masked copies; the two maps that are correlated, with gradients
        loss = FLOAT * pixels * ((36 if self.masked else 12) + 4 * self.depth_supervised)
        if not self.cuda:
            loss += 5 * FLOAT * (3 * self.width + 30) * -(-self.height // 8)
        # what an event sees of each view stays until its end: the picture, scores, the gate
        seen = 7 * FLOAT * pixels * min(self.views, SAMPLED) if self.scored else 0
        sampling = {"sampling": records + ranges + listing + seen + 3 * images} if self.scored else {}
        if banded:  # nothing of a band waits for the loss; in the backward pass its pictures stand beside the whole ones
            apart = records + 2 * record + images + upstream
            return {
                "binning": apart + ranges + sorting + listing,
                "loss": records + images + loss,
                "blending": apart + ranges + images + kept + backward,
                "projection": self._projection(count) + images + upstream,
                **sampling,
            }
        return {
            "binning": records + ranges + sorting + listing,
            "loss": records + ranges + images + kept + waiting + loss,
            "blending": records + record + ranges + images + kept + upstream + backward,
            "projection": self._projection(count) + images + upstream,
            **sampling,
        }

    def _projection(self, count: int) -> int:
        """Records, their gradient and its copy for the density statistics, and the gradients of the parameters."""
        return (FLOAT * (3 * PROJECTED_SIZE + 1) + self.row) * count

    def event(self, before: int, after: int) -> int:
        """Bytes on top of ``held(after)`` while Gaussians are added: new rows, and one tensor before, cut and grown."""
        added = min(2 * (after - before), after)  # a Gaussian that splits makes room for two
        return self.row * added + FLOAT * 3 * self.coefficients * (before + after)

    def step(self, count: int, instances: int, banded: bool = False) -> int:
        """Bytes at the heaviest moment of a step; each recording keeps memory of its own."""
        return self.held(count) + max(1, self.recordings) * max(self.moments(count, instances, banded).values())

    def smallest(self, count: int) -> int:
        """Bytes of the smallest step: a tile is not divided, and has at most as many instances as there are Gaussians."""
        return max(self.step(count, count, banded) for banded in (False, True))

    def most_instances(self, count: int, limit: int) -> int:
        """Instances that a step within a limit may have at a time, in a whole picture or in a band of it."""
        return _largest(1, MAX_INSTANCES, lambda n: max(self.step(count, n, banded) for banded in (False, True)) <= limit)

    def largest_count(self, limit: int, start: int, most: int) -> int:
        """Gaussians, from ``start`` up to ``most``, that steps and density events can reach within a limit."""

        def fits(count: int) -> bool:
            events = max(self.event(before, count) for before in (count // 2, count))
            return max(self.smallest(count), self.held(count) + events) <= limit

        return _largest(start, max(start, most), fits)


def _largest(low: int, high: int, fits: Callable[[int], bool]) -> int:
    """The largest number that fits, where all below it do; ``low`` if none does."""
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if fits(middle) else (low, middle - 1)
    return low


@dataclass(frozen=True)
class MemoryPlan:
    """What a fit was foretold to need, and how it keeps to its limit."""

    limit: int | None
    """Bytes that the fit may take; None where it was given no limit."""
    available: int
    """Bytes that the device had free."""
    gaussians: int
    """Number at the start."""
    instances: int
    """Most (Gaussian, tile) instances of a view at the start."""
    planned: int
    """Bytes of the first steps."""
    cap: int
    """Number of Gaussians that densification may reach."""
    planned_at_cap: int
    """Bytes there, if each Gaussian then touches as many tiles as now."""
    lowered_from: int | None = None
    """The cap that was asked for, where the limit lowered it."""
    banded: bool = False
    """Whether the first steps draw pictures in bands."""
    banded_at_cap: bool = False
    """Whether steps at the cap do."""
    graph_refused: bool = False
    """Whether recorded steps were given up for the sake of the limit."""

    def to_json(self) -> dict:
        """Plain values for metrics.json."""
        return asdict(self)

    def sentence(self) -> str:
        """One line for the user."""
        text = f"memory: {format_bytes(self.planned)} planned for a step now"
        if self.banded:
            text += ", the picture in bands"
        if self.cap > self.gaussians:
            about = "" if self.limit is not None else "about "
            text += f", {about}{format_bytes(self.planned_at_cap)} at {self.cap:,} Gaussians"
            if self.banded_at_cap and not self.banded:
                text += ", then in bands"
        if self.limit is None:
            if self.planned_at_cap > self.available:
                fraction = (self.available - self.planned) / max(1, self.planned_at_cap - self.planned)
                reached = int(self.gaussians + max(0.0, fraction) * (self.cap - self.gaussians))
                text += (
                    f"; the {format_bytes(self.available)} that are free are reached at about {reached:,}, --memory-limit helps"
                )
            return text
        text += f"; limit {format_bytes(self.limit)}"
        if self.lowered_from is not None:
            text += f", so there will be at most {self.cap:,} Gaussians, not {self.lowered_from:,}"
        if self.graph_refused:
            text += ", and steps are taken one by one, not as a recorded graph, which would need more"
        return text


def layout_of(
    gaussians: Gaussians,
    cameras: list[Camera],
    masked: list[bool],
    *,
    scored: bool,
    recorded: bool,
    depth_supervised: bool = False,
) -> Layout:
    """The layout of a fit to views with these cameras, recorded where the device can and ``recorded`` says so."""
    largest = max(cameras, key=lambda c: c.width * c.height)
    cuda, kinds = gaussians.means.is_cuda, {(c.width, c.height, m) for c, m in zip(cameras, masked)}
    return Layout(
        gaussians.sh.shape[1], largest.width, largest.height, sum(c.width * c.height for c in cameras), len(cameras),
        any(masked), scored, depth_supervised, cuda, len(kinds) if cuda and recorded else 0,
    )  # fmt: skip


@torch.no_grad()
def most_instances(gaussians: Gaussians, cameras: list[Camera], rule: str) -> int:
    """(Gaussian, tile) instances of the camera that has most; cameras hold tensors."""
    counts = []
    for c in cameras:
        how = {"width": c.width, "height": c.height, "degree": 0, "rule": RULES[rule]}
        counts.append(int(project(*gaussians.tensors().values(), c.viewmat[None], c.K[None], **how)[1].sum()))
    return max(counts)


def plan(
    layout: Layout, *, count: int, instances: int, most: int, limit: int | None, available: int, capacity_factor: float = 1.0
) -> tuple[MemoryPlan, Layout]:
    """Plan a fit that starts with ``count`` Gaussians, whose heaviest view has ``instances``, and may reach ``most``.

    Args:
        layout: How steps are to be taken; with recordings if possible.
        count: Gaussians at the start.
        instances: Most (Gaussian, tile) instances of a view at the start.
        most: Number of Gaussians that densification may reach.
        limit: Bytes, or None.
        available: Bytes that the device has free.
        capacity_factor: Instances that a recording makes room for, as a multiple of what there are.

    Returns:
        The plan, and the layout of the steps to be taken: without recordings where those would not keep to the limit.

    Raises:
        UsageError: The limit is below what the smallest step needs.
    """
    cap, refused = max(most, count), False
    single = replace(layout, recordings=0)
    if limit is not None:
        if not single.smallest(count) <= limit:
            raise UsageError(
                f"--memory-limit {format_bytes(limit)} is less than the {format_bytes(single.smallest(count))} that the "
                f"smallest step needs with {count:,} Gaussians and {layout.width} x {layout.height} px; raise the limit, start "
                "with fewer points (--max-gaussians N), or --downscale the views"
            )
        cap = single.largest_count(limit, count, cap)
        graphs = layout.step(cap, int(capacity_factor * instances / count * cap))
        if layout.recordings and max(graphs, layout.held(cap) + layout.event(cap // 2, cap)) > limit:
            layout, refused = single, True

    def needed(at: int) -> tuple[int, bool]:
        there = int(instances / count * at * (capacity_factor if layout.recordings else 1))
        whole = layout.step(at, there)
        if limit is None or whole <= limit:
            return whole, False
        return layout.step(at, min(there, layout.most_instances(at, limit)), banded=True), True

    (now, banded), (then, banded_then) = needed(count), needed(cap)
    lowered = most if cap < most else None
    made = MemoryPlan(limit, available, count, instances, now, cap, then, lowered, banded, banded_then, refused)
    return made, layout
