"""Depth of a model's surface as many views see it, and where the views agree."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from warpgs.constants import NEAR
from warpgs.geometry import back_project, pinhole_of, relative_pose, rotation_matrices
from warpgs.kernels.tsdf import face_cosines
from warpgs.priors.sweep import matching_views, shared_sight
from warpgs.process import Say, silent
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, Gaussians

# Depth of a surface along each ray: where the Gaussians of a pixel are densest, and the fraction of their weight there.
#
# The depth of a Gaussian's mean, which the rasterizer reports, makes steps on a slanted surface. Here, a Gaussian's
# depth is where its density along the ray is largest.

CONTRIBUTORS = 32
"""Number of Gaussians that are used for a pixel: those with the largest blending weights."""
BAND = 0.02
"""Largest difference from the median depth, as a fraction of the median, that counts as the same surface."""
MIN_SHARE = 0.5
"""A pixel shows a surface if at least this fraction of its weights is within `BAND` of the median depth
(docs/decisions/027-mesh-depth.md)."""
BLOCK = 2**15
"""Number of pixels that are processed at a time: 38 MB for the matrices of their Gaussians."""


def whitening(gaussians: Gaussians, camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    """Return maps of camera space [N, 3, 3] that make each Gaussian isotropic, and the means in camera space [N, 3] [u]."""
    view = torch.as_tensor(camera.viewmat, dtype=gaussians.means.dtype, device=gaussians.means.device)
    axes = rotation_matrices(torch.nn.functional.normalize(gaussians.quats, dim=1))
    # elementwise, not as a product of matrices: its bits would depend on the processor
    turned = (axes.mT[:, :, None] * view[None, None, :3, :3]).sum(-1)
    means = (gaussians.means[:, None] * view[None, :3, :3]).sum(-1) + view[:3, 3]
    scales = gaussians.log_scales
    return turned * torch.exp(scales.amin(1, keepdim=True) - scales)[..., None], means


def densest_depths(matrices: torch.Tensor, means: torch.Tensor, rays: torch.Tensor, ids: torch.Tensor) -> torch.Tensor:
    """Return the z-depths [P, k] [u] at which Gaussians ``ids`` [P, k] are densest along rays [P, 3] with z = 1."""
    own, mean = matrices[ids], means[ids]
    along = (own * rays[:, None, None]).sum(-1)
    squared = (along * along).sum(-1)
    depth = (along * (own * mean[:, :, None]).sum(-1)).sum(-1) / squared
    return torch.where((squared > 0) & torch.isfinite(depth) & (depth > 0), depth, mean[..., 2])


def weighted_median(depths: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    """Return the weighted median [P] of depths [P, k] with weights [P, k]; depths of weight 0 are ignored."""
    order = torch.where(weights > 0, depths, torch.inf).argsort(dim=1, stable=True)
    sums = weights.gather(1, order).cumsum(1)
    return depths.gather(1, order.gather(1, (2 * sums >= sums[:, -1:]).int().argmax(1, keepdim=True)))[:, 0]


def _pixel_axes(camera: Camera, like: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return x [W] and y [H] of the rays with z = 1 through the centres of a pinhole camera's pixels, typed as ``like``."""
    x, y = (torch.arange(n, dtype=like.dtype, device=like.device) + 0.5 for n in (camera.width, camera.height))
    K = camera.K
    return (x - float(K[0, 2])) / float(K[0, 0]), (y - float(K[1, 2])) / float(K[1, 1])


def surface_depth(
    gaussians: Gaussians, camera: Camera, ids: torch.Tensor, weights: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the median depth [H, W] [u] of each pixel's Gaussians [H, W, k], and the share of weight within `BAND` of it."""
    height, width, k = ids.shape
    if not len(gaussians):
        return weights.new_zeros(height, width), weights.new_zeros(height, width)
    matrices, means = whitening(gaussians, camera)
    x, y = _pixel_axes(camera, means)
    rays = torch.stack([x.repeat(height), y.repeat_interleave(width), x.new_ones(height * width)], 1)
    blocks = []
    for r, w, i in zip(*(t.split(BLOCK) for t in (rays, weights.reshape(-1, k), ids.reshape(-1, k).clamp_min(0)))):
        depths, sums = densest_depths(matrices, means, r, i.long()), w.sum(1)
        median = weighted_median(depths, w)
        near = (depths - median[:, None]).abs() <= BAND * median[:, None]
        share = torch.where(near, w, 0).sum(1) / torch.where(sums > 0, sums, 1)
        blocks.append(torch.stack([torch.where(sums > 0, median, 0), share]))
    depth, share = torch.cat(blocks, 1).reshape(2, height, width)
    return depth, share


DEPTHS = ("median", "mean")
"""Kinds of rendered depth that can be fused."""
MIN_ALPHA = 0.5
"""Least opacity of a pixel that shows a surface."""
EMPTY = 0.02
"""Opacity below which a pixel is empty: five of 255 levels."""
SAMPLES = 200_000
"""Number of pixels of all views that are sampled to find the extent of the surfaces."""
UNCERTAIN = 1e-3
"""Weight of an uncertain depth, if holes are filled, as a fraction of a certain one's: it counts where no view is certain."""
KEPT_PIXELS = 2**24
"""Largest number of pixels of all views together for which renders are kept, 320 MiB; otherwise every use renders again."""


@dataclass(frozen=True)
class SurfaceView:
    """Surface that one camera sees."""

    camera: Camera
    """Pinhole camera, arrays of numpy."""
    depth: torch.Tensor
    """z-depth [u], shape [H, W]; infinite for an empty pixel, 0 where it is uncertain and holes are not filled."""
    weights: torch.Tensor
    """Weight of each pixel, in [0, 1], shape [H, W]: the cosine between ray and normal, times alpha if there is a surface."""
    image: torch.Tensor
    """Colours, shape [H, W, 3]."""


@torch.no_grad()
def surface_view(
    gaussians: Gaussians, camera: Camera, options: RasterizeOptions, depth: str = "median", fill: bool = False
) -> SurfaceView:
    """Render what a camera sees of the surface, by one of `DEPTHS`; a lens is replaced by the pinhole of the same K."""
    camera = pinhole_of(camera)
    r = rasterize(gaussians, camera, replace(options, heaviest=CONTRIBUTORS if depth == "median" else 0))
    z, certain = r.depth, torch.ones_like(r.depth)
    if r.heaviest_ids is not None and r.heaviest_weights is not None:
        z, share = surface_depth(gaussians, camera, r.heaviest_ids, r.heaviest_weights)
        certain = torch.where(share >= MIN_SHARE, certain, UNCERTAIN if fill else 0.0)
        z = torch.where(certain > 0, z, 0)
    z = torch.where(r.alpha >= MIN_ALPHA, z, torch.where(r.alpha <= EMPTY, torch.inf, 0.0)).contiguous()
    weights = face_cosines(z, camera) * torch.where(torch.isfinite(z), r.alpha * certain, 1.0)
    return SurfaceView(camera, z, weights, r.rgb.contiguous())


class SurfaceViews:
    """Surfaces that the cameras see, in the order of the cameras; they can be iterated several times.

    If all views together have at most `KEPT_PIXELS` pixels, each view is rendered once and kept. Otherwise every iteration
    renders the views again, one at a time.
    """

    def __init__(
        self, gaussians: Gaussians, cameras: Sequence[Camera], options: RasterizeOptions, depth: str,
        stage: Say = silent, fill: bool = False,
    ) -> None:  # fmt: skip
        """Prepare to render a model from all cameras by one of `DEPTHS`; ``stage`` shows a line before each view."""
        self._render = lambda camera: surface_view(gaussians, camera, options, depth, fill)
        self.cameras, self._stage = cameras, stage
        self._keeps = sum(c.width * c.height for c in cameras) <= KEPT_PIXELS
        self._kept: dict[int, SurfaceView] = {}

    def __call__(self, purpose: str, chosen: Sequence[int] | None = None) -> Iterator[SurfaceView]:
        """Yield what each camera, or those ``chosen``, sees of the surface; ``purpose`` is the line of progress."""
        chosen = range(len(self.cameras)) if chosen is None else chosen
        for done, i in enumerate(chosen):
            self._stage(f"{purpose}: view {done + 1} of {len(chosen)}")
            view = self._kept.get(i) or self._render(self.cameras[i])
            if self._keeps:
                self._kept[i] = view
            yield view


def sample_surface(view: SurfaceView, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return about ``count`` points of a view's certain surface, [N, 3] [u], and the width of a pixel there, [N] [u]."""
    depth, camera = torch.where(view.weights > UNCERTAIN, view.depth, 0).cpu().numpy().astype(np.float64), view.camera
    step = max(1, round((depth.size / count) ** 0.5))
    row, column = np.mgrid[step // 2 : depth.shape[0] : step, step // 2 : depth.shape[1] : step].reshape(2, -1)
    z = depth[row, column]
    seen = (z > 0) & np.isfinite(z)
    pixels = np.stack([column, row], 1)[seen] + 0.5
    return back_project(camera, pixels, z[seen]), z[seen] / float(np.sqrt(camera.K[0, 0] * camera.K[1, 1]))


# Agreement of views on depth: a mesh omits a point if other views see surfaces there, but none at the point's depth.
#
# A fit of few views constrains depth only where two views look. If only one view sees a surface, such as beside an
# occluding edge, the surface's depth is unconstrained.

TOLERANCE = 0.02
"""Largest difference of two depths of one surface, as a fraction of the depth. Measured on training photographs alone: at this
difference, the squared colour difference of two photographs is twice (3 dB) the value at the best agreement of depths (decision
019)."""
NEIGHBOURS = 16
"""Largest number of views that each view is compared with: the nearest that see the same surface from another angle."""
MAX_PIXELS = 2**26
"""Largest number of depths in all maps together, 256 MiB; if images have more pixels, maps store every ``step``-th pixel."""
BOUNDS = (0.02, 0.98)
"""Quantiles of a view's depths that are used as the depths of the nearest and farthest surface."""


DepthMap = tuple[Camera, torch.Tensor, int, tuple[float, float]]
"""Depth of one view, kept to compare other views with: the pinhole camera of the whole image (numpy); z-depth [u] of every
``step``-th pixel of every ``step``-th row, 0 without a surface, shape [h, w]; the step [px]; and the smallest and largest depth
of the surface, without outliers (`BOUNDS`)."""


def depth_map(view: SurfaceView, views: int) -> DepthMap:
    """Return the depth of a view for comparisons among ``views`` views."""
    step = max(1, int(np.ceil((view.depth.numel() * views / MAX_PIXELS) ** 0.5)))
    depth = view.depth[step // 2 :: step, step // 2 :: step]
    depth = torch.where(torch.isfinite(depth), depth, 0).contiguous()
    known = depth[depth > 0].cpu().numpy()
    near, far = map(float, np.quantile(known, BOUNDS) if len(known) else (1.0, 1.0))
    return view.camera, depth, step, (near, max(far, near * 1.01))


def neighbours(maps: Sequence[DepthMap]) -> list[list[int]]:
    """Return the views that each view is compared with, by index, nearest first."""
    cameras = [camera for camera, *_ in maps]
    sight = shared_sight(cameras, [bounds for *_, bounds in maps])
    return [matching_views(sight, cameras, i, NEIGHBOURS, range(len(maps))) for i in range(len(maps))]


def agreed(view: SurfaceView, others: Sequence[DepthMap], fill: bool = False) -> SurfaceView:
    """Return a view without the depths that no other view confirms within `TOLERANCE`, though one sees a surface there.

    If holes are filled, these depths are uncertain instead.
    """
    # A depth is kept if at least one other view has a surface within `TOLERANCE` of the depth's point. A depth is also kept if
    # its point projects onto no surface in any other view, such as outside of all other images. So a single view keeps all its
    # depths.
    shown = torch.isfinite(view.depth) & (view.depth > 0)
    confirmed, questioned = torch.zeros_like(shown), torch.zeros_like(shown)
    for camera, depth, step, _ in others:
        _, _, difference = depth_difference(torch.where(shown, view.depth, 0), view.camera, camera, depth, step)
        confirmed |= difference <= TOLERANCE
        questioned |= torch.isfinite(difference)
    kept = confirmed | ~questioned | ~shown
    if fill:
        return replace(view, weights=torch.where(kept, view.weights, UNCERTAIN * view.weights))
    return replace(view, depth=torch.where(kept, view.depth, 0), weights=torch.where(kept, view.weights, 0))


def seen_from(depth: torch.Tensor, camera: Camera, other: Camera) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return column and row [px] and z-depth [u] in another view of the points at a view's pixels, shape [H, W] each."""
    # No product of matrices is used, because its bits would depend on the processor. For points behind the other view, columns
    # and rows are undefined.
    rotation, translation = relative_pose(camera, other)
    x, y = _pixel_axes(camera, depth)
    px, py, z = (
        depth * (x[None] * float(r[0]) + (y[:, None] * float(r[1]) + float(r[2]))) + float(t)
        for r, t in zip(rotation, translation)
    )
    K, safe = other.K, torch.where(z > NEAR, z, torch.inf)
    u, v = (p / safe * float(K[i, i]) + float(K[i, 2]) for i, p in enumerate((px, py)))
    return u, v, z


def depth_difference(
    depth: torch.Tensor, camera: Camera, other: Camera, surface: torch.Tensor, step: int = 1
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return column and row [px] in another view of a view's points, and the difference to its surface, [H, W] each.

    ``surface`` [h, w] is every ``step``-th depth of the other view. The difference is a fraction of depth, and infinite where
    the pixel has no depth, outside of the other image, and where no surface is seen there.
    """
    u, v, z = seen_from(depth, camera, other)
    inside = (depth > 0) & (z > NEAR) & (u >= 0) & (u < other.width) & (v >= 0) & (v < other.height)
    left, top = (torch.floor((a - (step // 2 + 0.5)) / step) for a in (u, v))
    height, width = surface.shape
    columns = [(left + i).clamp(0, width - 1).long() for i in (0, 1)]
    rows = [(top + i).clamp(0, height - 1).long() * width for i in (0, 1)]
    # the nearest of the four depths around the point, since depth varies within a pixel on a slanted surface
    known = torch.where(surface > 0, surface, torch.inf)
    least = torch.full_like(z, torch.inf)
    for row, column in itertools.product(rows, columns):
        torch.minimum(least, known.take(row + column).sub_(z).abs_(), out=least)
    return u, v, torch.where(inside, least / z, torch.inf)
