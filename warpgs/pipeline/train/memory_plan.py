"""Memory that a fit needs, predicted from the tensors that the kernels allocate, and the means to keep to a limit.

A step holds parameters with their moments throughout, and on top of them what its heaviest moment needs. Counted are the
tensors of the fit while it takes steps; what the CUDA driver, Python and the compiled kernels occupy comes on top. Not counted,
since they are small: parameters of single views, and the buffers of learning rates and losses (`StepBuffers`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace

import torch

from warpgs.constants import RULES, TILE_SIZE
from warpgs.errors import UsageError
from warpgs.kernels import blend, blend_cuda
from warpgs.kernels.project import PROJECTED_SIZE
from warpgs.kernels.tiles import LIST_BYTES, MAX_INSTANCES, grid
from warpgs.pipeline.model.table import Table
from warpgs.pipeline.train.view_modules.base import ViewModule
from warpgs.pipeline.train.views import TrainingView
from warpgs.render.compose import count_instances, inputs_of, settings_of
from warpgs.runtime.byte_units import format_bytes
from warpgs.runtime.terminal import Detail
from warpgs.scene import Camera, Gaussians

FLOAT = 4
"""Bytes of a float32 or int32."""
SAMPLED = 8
"""Largest number of views that a sampling event samples in (`importance_sampling.MAX_VIEWS`)."""
SUMMED = 2
"""Statistics of each Gaussian that are summed with the gradients of several views: sum of its gradients, number of renders."""


def instance_bytes(cuda: bool, tiles: int) -> tuple[int, int]:
    """Return the bytes of a (Gaussian, tile) instance in an image of so many tiles: in binning, and in the backward pass.

    The backward pass has the lists without the owners, the gradient slots and, on CUDA, the states that blending left.
    """
    kept = LIST_BYTES - FLOAT
    if not cuda:
        return LIST_BYTES, kept + FLOAT * blend.VALUES
    chunk = blend_cuda.CHUNKS[int(tiles > blend_cuda.MAX_SMALL_TILES)]
    return LIST_BYTES, kept + FLOAT * blend_cuda.STRIDE + FLOAT * blend_cuda.STATE * TILE_SIZE * TILE_SIZE // chunk


@dataclass(frozen=True)
class Layout:
    """Sizes that, with the numbers of Gaussians and instances, decide what a step needs."""

    coefficients: int
    """Spherical-harmonics coefficients a channel, K."""
    width: int
    """Width of the largest view [px]."""
    height: int
    """Height of the largest view [px]."""
    view_bytes: int
    """Bytes of all views, those included that are kept beside them (`view_bytes`)."""
    column_bytes: int = 0
    """Bytes of the strategy's columns for each Gaussian."""
    views: int = 1
    """Number of views."""
    masked: bool = False
    """True where a view has a mask."""
    scored: bool = False
    """True where views have scores, by which fine Gaussians are sampled."""
    depth_supervised: bool = False
    """True where a loss term reads depth."""
    cuda: bool = False
    """True on a CUDA device."""
    graphs: int = 0
    """CUDA graphs that exist at a time, one for each size of view; 0 where steps are taken one by one."""
    cutout: bool = False
    """True where views know their opacity."""
    sums: int = 0
    """Sums of gradients and statistics that a step of several views keeps (`warpgs.pipeline.train.slots`)."""
    modules: tuple[ViewModule, ...] = ()
    """View modules, which count what steps take for them."""

    @property
    def row(self) -> int:
        """Bytes of the parameters of a Gaussian."""
        return FLOAT * (3 + 4 + 3 + 1 + 3 * self.coefficients)

    def held(self, count: int) -> int:
        """Return the bytes that last from step to step: parameters, two Adam moments, columns, sums over slots, and views."""
        sums = self.sums * (self.row + SUMMED * FLOAT)
        return (3 * self.row + self.column_bytes + sums) * count + self.view_bytes

    def moments(self, count: int, instances: int, chunked: bool) -> dict[str, int]:
        """Return the bytes on top of `held` at each moment of a step that may be its heaviest.

        ``instances`` is the number in the image or, if ``chunked``, in its heaviest chunk.
        """
        pixels = self.width * self.height
        columns, rows = grid(self.width, self.height, TILE_SIZE)
        listing, backward = (b * instances for b in instance_bytes(self.cuda, 0 if chunked else columns * rows))
        waiting = backward - FLOAT * (blend_cuda.STRIDE if self.cuda else blend.VALUES) * instances
        one = FLOAT * PROJECTED_SIZE * count  # projected Gaussians, or their gradient
        projected = one + FLOAT * count  # with the tile counts
        ranges = 8 * columns * rows + 2 * FLOAT * count
        sorting = count * (FLOAT * 4 + 2 * 8)  # depths and order twice, two running sums
        images = 5 * FLOAT * pixels  # colour, alpha, depth
        kept = 3 * FLOAT * pixels  # transmittance, weight, end: what blending leaves for its gradient
        upstream = FLOAT * pixels * (3 if self.cuda and not (self.depth_supervised or self.cutout) else 5)
        # three partials for each colour and the gradient; masked copies; the two maps that are correlated, with gradients
        # the difference of opacities and its gradient
        loss = FLOAT * pixels * ((19 if self.masked else 12) + 4 * self.depth_supervised + 3 * self.cutout)
        loss += self._of_modules("loss", count)
        if not self.cuda:
            loss += 5 * FLOAT * (3 * self.width + 30) * -(-self.height // 8)
        # an event keeps image, scores and gate of each view until its end
        seen = 7 * FLOAT * pixels * min(self.views, SAMPLED) if self.scored else 0
        sampling = {"sampling": projected + ranges + listing + seen + 3 * images} if self.scored else {}
        # on CUDA a step copies image, mask, opacity and disparity of its view from the stacks
        own = FLOAT * pixels * (3 + self.masked + self.cutout + self.depth_supervised) if self.cuda else 0
        own += FLOAT * pixels * 6 * self.cutout  # the image over the step's background, and what was added to it
        if chunked:  # nothing of a chunk waits for the loss; in the backward pass its images stand beside the whole ones
            apart = own + projected + 2 * one + images + upstream
            return {
                "binning": apart + ranges + sorting + listing,
                "loss": own + projected + images + loss,
                "blending": apart + ranges + images + kept + backward,
                "projection": own + self._projection(count) + images + upstream,
                **sampling,
            }
        return {
            "binning": own + projected + ranges + sorting + listing,
            "loss": own + projected + ranges + images + kept + waiting + loss,
            "blending": own + projected + one + ranges + images + kept + upstream + backward,
            "projection": own + self._projection(count) + images + upstream,
            **sampling,
        }

    def _projection(self, count: int) -> int:
        """Return the bytes of projected Gaussians, of their gradient and its copy for statistics, and of other gradients."""
        return (FLOAT * (3 * PROJECTED_SIZE + 1) + self.row) * count + self._of_modules("projection", count)

    def _of_modules(self, moment: str, count: int) -> int:
        """Return the bytes that view modules take at a moment of a step."""
        return sum(m.bytes(count, self.width * self.height).get(moment, 0) for m in self.modules)

    def event(self, before: int, after: int) -> int:
        """Return the bytes on top of ``held(after)`` while Gaussians are added: new rows, and one tensor before and after."""
        added = min(2 * (after - before), after)  # a split replaces one Gaussian by two
        numbers = 2 * FLOAT * after  # of the rows that stay, and of parents, int64
        return self.row * added + FLOAT * 3 * self.coefficients * (before + after) + numbers

    def step(self, count: int, instances: int, chunked: bool = False) -> int:
        """Return the bytes at the heaviest moment of a step; each CUDA graph keeps memory of its own."""
        heaviest = max(1, self.graphs) * max(self.moments(count, instances, chunked).values())
        return self.held(count) + heaviest

    def smallest(self, count: int) -> int:
        """Return the bytes of the smallest step: a tile is not divided, and has at most as many instances as Gaussians."""
        return max(self.step(count, count, chunked) for chunked in (False, True))

    def most_instances(self, count: int, limit: int) -> int:
        """Return the instances that a step within a limit may have at a time, in a whole image or in a chunk of it."""
        return _largest(1, MAX_INSTANCES, lambda n: max(self.step(count, n, chunked) for chunked in (False, True)) <= limit)

    def largest_count(self, limit: int, start: int, most: int) -> int:
        """Return the Gaussians, from ``start`` up to ``most``, that steps and density events can reach within a limit."""

        def fits(count: int) -> bool:
            events = max(self.event(before, count) for before in (count // 2, count))
            return max(self.smallest(count), self.held(count) + events) <= limit

        return _largest(start, max(start, most), fits)


def _largest(low: int, high: int, fits: Callable[[int], bool]) -> int:
    """Return the largest number that fits, where all below it do; ``low`` if none does."""
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if fits(middle) else (low, middle - 1)
    return low


@dataclass(frozen=True)
class MemoryPlan:
    """Predicted memory of a fit, and the means by which it keeps to its limit."""

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
    """Bytes of steps at the cap, if each Gaussian then touches as many tiles as at the start."""
    lowered_from: int | None = None
    """Cap that was asked for, where the limit lowered it."""
    chunked: bool = False
    """True where the first steps render images in chunks."""
    chunked_at_cap: bool = False
    """True where steps at the cap do."""
    graph_refused: bool = False
    """True where captured steps would not keep to the limit, and steps are taken one by one."""

    def to_json(self) -> dict:
        """Return plain values for metrics.json."""
        return asdict(self)

    def summary(self) -> str:
        """Return one line for the user."""
        text = f"memory: {format_bytes(self.planned)} planned for a step now"
        if self.chunked:
            text += ", the image in chunks"
        if self.cap > self.gaussians:
            about = "" if self.limit is not None else "about "
            text += f", {about}{format_bytes(self.planned_at_cap)} at {self.cap:,} Gaussians"
            if self.chunked_at_cap and not self.chunked:
                text += ", then in chunks"
        if self.limit is None:
            if self.planned_at_cap > self.available:
                fraction = (self.available - self.planned) / max(1, self.planned_at_cap - self.planned)
                reached = int(self.gaussians + max(0.0, fraction) * (self.cap - self.gaussians))
                text += (
                    f"; the {format_bytes(self.available)} that are free are reached at about {reached:,}, --memory-limit helps"
                )
                return text
            return text if self.chunked else Detail(text)
        text += f"; limit {format_bytes(self.limit)}"
        if self.lowered_from is not None:
            text += f", so there will be at most {self.cap:,} Gaussians, not {self.lowered_from:,}"
        if self.graph_refused:
            text += ", and steps are taken one by one, not as a CUDA graph, which would need more"
        return text


def layout_of(
    table: Table,
    views: Sequence[TrainingView],
    *,
    kept: Sequence[TrainingView] = (),
    scored: bool = False,
    captured: bool = False,
    depth_supervised: bool = False,
    modules: tuple[ViewModule, ...] = (),
    sums: int = 0,
) -> Layout:
    """Return the layout of steps of a fit.

    Args:
        table: The Gaussians with their columns.
        views: Training views, those at half their size included.
        kept: Views that are kept beside them.
        scored: True where fine Gaussians are sampled by scores.
        captured: True to capture steps as CUDA graphs where the device can.
        depth_supervised: True where a loss term reads depth.
        modules: View modules of the fit.
        sums: Sums of gradients that a step of several views keeps.
    """
    largest = max((v.camera for v in views), key=lambda c: c.width * c.height)
    cuda = table.device.type == "cuda"
    return Layout(
        table.gaussians.sh.shape[1], largest.width, largest.height, view_bytes([*views, *kept]),
        sum(c.element_size() for c in table.columns.values()), len(views), any(v.mask is not None for v in views),
        scored, depth_supervised, cuda, len({v.kind for v in views}) if cuda and captured else 0,
        any(v.alpha is not None for v in views), sums, modules,
    )  # fmt: skip


def view_bytes(views: Iterable[TrainingView]) -> int:
    """Return the bytes of views: images, masks, opacities, maps and scores, memory that several share counted once.

    Stacks are not counted: on CUDA images, masks, opacities and maps of the views are parts of them (`stack_views`), elsewhere
    there are none.
    """
    tensors = (t for v in views for t in (v.image, v.mask, v.alpha, v.semantic, v.geometry, v.consistent, *v.maps.values()))
    storages = (t.untyped_storage() for t in tensors if t is not None)
    return sum({s.data_ptr(): s.nbytes() for s in storages}.values())


@torch.no_grad()
def most_instances(gaussians: Gaussians, cameras: list[Camera], rule: str) -> int:
    """Return the (Gaussian, tile) instances of the camera that has most; cameras hold tensors."""
    return max(int(count_instances(inputs_of(gaussians, c), settings_of(c, 0, RULES[rule]))) for c in cameras)


def plan(
    layout: Layout, *, count: int, instances: int, most: int, limit: int | None, available: int, capacity_factor: float = 1.0
) -> tuple[MemoryPlan, Layout]:
    """Plan a fit that starts with ``count`` Gaussians, whose heaviest view has ``instances``, and may reach ``most``.

    Args:
        layout: Layout of the steps; with graphs if possible.
        count: Gaussians at the start.
        instances: Most (Gaussian, tile) instances of a view at the start.
        most: Number of Gaussians that densification may reach.
        limit: Bytes that the fit may take; None for no limit.
        available: Bytes that the device has free.
        capacity_factor: Capacity of a CUDA graph for instances, as a multiple of what there are.

    Returns:
        The plan, and the layout of the steps to be taken: without graphs where those would not keep to the limit.

    Raises:
        UsageError: The limit is below what the smallest step needs.
    """
    cap, refused = max(most, count), False
    single = replace(layout, graphs=0)
    if limit is not None:
        if not single.smallest(count) <= limit:
            raise UsageError(
                f"--memory-limit {format_bytes(limit)} is less than the {format_bytes(single.smallest(count))} that the "
                f"smallest step needs with {count:,} Gaussians and {layout.width} x {layout.height} px; raise the limit, start "
                "with fewer points (--max-gaussians N), or --downscale the views"
            )
        cap = single.largest_count(limit, count, cap)
        graphs = layout.step(cap, int(capacity_factor * instances / count * cap))
        if layout.graphs and max(graphs, layout.held(cap) + layout.event(cap // 2, cap)) > limit:
            layout, refused = single, True

    def needed(at: int) -> tuple[int, bool]:
        there = int(instances / count * at * (capacity_factor if layout.graphs else 1))
        whole = layout.step(at, there)
        if limit is None or whole <= limit:
            return whole, False
        return layout.step(at, min(there, layout.most_instances(at, limit)), chunked=True), True

    (now, chunked), (then, chunked_then) = needed(count), needed(cap)
    lowered = most if cap < most else None
    made = MemoryPlan(limit, available, count, instances, now, cap, then, lowered, chunked, chunked_then, refused)
    return made, layout
