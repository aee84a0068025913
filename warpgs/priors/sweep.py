"""Depth by plane sweep: which views to compare, which planes, and the depth that fits best."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from warpgs import geometry
from warpgs.device import format_bytes, installed_bytes
from warpgs.kernels.sweep import NEUTRAL, best_inverses, check_round_trip, plane_costs, scanline_costs
from warpgs.priors.flow import homogeneous, no_depth
from warpgs.priors.networks import in_threads, single_threaded_opencv
from warpgs.scene import Camera, View, ViewDepth

SMOOTHNESS = (1e2, 1e4, 1e6)
"""Strengths of the smoother, in order. A stronger smoother reaches farther; each pixel uses the first that reaches it."""
COLOR_SIGMA = 8.0
"""Colour difference [1/255] at which the weight between neighbours falls to 1/e."""
MIN_FRACTION = 1e-3
"""Smallest fraction of a smoothed value that must come from consistent pixels."""


def complete(depth: np.ndarray, valid: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Fill a depth map [u], [H, W], by edge-aware averages of inverse depth; the median where no valid depth reaches."""
    # Smoothed inverse depths by the smoothed mask (Min et al. 2014): planes stay planes, and far surfaces are not pulled near.
    # Measured in docs/decisions/007-coarse-start.md.
    import cv2

    if not valid.any():
        return np.zeros(depth.shape, np.float32)
    inverse = np.where(valid, 1 / np.where(valid, depth, 1), 0).astype(np.float32)
    guide = (image * 255).round().clip(0, 255).astype(np.uint8)
    filled = np.full(depth.shape, np.median(inverse[valid]))
    left = np.ones(depth.shape, bool)
    with single_threaded_opencv():
        for strength in SMOOTHNESS:
            smoother = cv2.ximgproc.createFastGlobalSmootherFilter(guide, strength, COLOR_SIGMA)
            fraction = smoother.filter(valid.astype(np.float32))
            filled_now = left & (fraction > MIN_FRACTION)
            filled[filled_now] = smoother.filter(inverse)[filled_now] / fraction[filled_now]
            left &= ~filled_now
            if not left.any():
                break
    low, high = inverse[valid].min(), inverse[valid].max()
    return np.where(valid, depth, 1 / filled.clip(low, high)).astype(np.float32)


SAMPLES = 4
"""Number of sampled pixels along each side of an image."""
DEPTHS = 3
"""Number of depths at each sampled pixel."""
LEAST_ANGLE, MOST_ANGLE, LOST_ANGLE = 1.0, 30.0, 60.0
"""Angles between two rays to a point [deg]. Below the first, depth is uncertain. Above the second, a surface looks different to
both views. From the third on, the views are assumed to share nothing."""


Sight = tuple[np.ndarray, np.ndarray]
"""Shared sight of pairs of V views, [V, V] each, as fractions of what the first view of a pair sees. Overlap: what the second
sees, too, less at larger angles. Matching: the same, weighted by how well depth can be found at the angle; 0 for a view and
itself."""


def _sampled(camera: Camera, bounds: tuple[float, float]) -> np.ndarray:
    """Return points [S, 3] that a camera may see: at a grid of pixels, and depths evenly spaced in their logarithm."""
    geometry.check_pinhole(camera)
    along = (np.arange(SAMPLES) + 0.5) / SAMPLES
    x, y = (a.ravel() for a in np.meshgrid(along * camera.width, along * camera.height))
    near, far = bounds
    depths = [near * (far / near) ** ((k + 0.5) / DEPTHS) for k in range(DEPTHS)]
    return geometry.back_project(camera, np.tile(np.stack([x, y], 1), (DEPTHS, 1)), np.repeat(depths, len(x)))


def shared_sight(cameras: Sequence[Camera], bounds: Sequence[tuple[float, float]]) -> Sight:
    """Return what pairs of views share, by projecting points sampled in each camera's frustum into all others."""
    # the view selection of multi-view stereo (Goesele et al. 2007; angles as in Yao et al. 2018), on sampled points
    turns, shifts = np.stack([c.viewmat[:3, :3] for c in cameras]), np.stack([c.viewmat[:3, 3] for c in cameras])
    K, centers = np.stack([c.K for c in cameras]), np.stack([c.center for c in cameras])
    sides = np.array([(c.width, c.height) for c in cameras], float)
    least, most, lost = (1 - np.cos(np.radians(a)) for a in (LEAST_ANGLE, MOST_ANGLE, LOST_ANGLE))
    overlap, matching = np.zeros((2, len(cameras), len(cameras)))
    for i, (camera, near_far) in enumerate(zip(cameras, bounds)):
        points = _sampled(camera, near_far)
        local = (turns[:, None] * points[None, :, None, :]).sum(3) + shifts[:, None]  # [V, S, 3]
        ahead = local[..., 2] > 1e-9
        z = np.where(ahead, local[..., 2], 1)
        u = (K[:, None, 0] * local).sum(2) / z
        v = (K[:, None, 1] * local).sum(2) / z
        seen = ahead & (u >= 0) & (v >= 0) & (u < sides[:, :1]) & (v < sides[:, 1:])
        rays = points[None] - centers[:, None]
        rays /= np.maximum(np.sqrt((rays**2).sum(2, keepdims=True)), 1e-12)
        turned = 1 - (rays * rays[i]).sum(2)  # 1 - cosine grows with the square of a small angle
        alike = np.clip((lost - turned) / (lost - most), 0, 1)
        overlap[i] = (seen * np.clip(1 - np.sqrt(np.maximum(turned, 0) / lost), 0, 1)).mean(1)
        matching[i] = (seen * alike * np.clip(turned / least, 0, 1)).mean(1)
        matching[i, i] = 0
    return np.round(overlap, 9), np.round(matching, 9)  # rounding errors must not decide


def matching_views(sight: Sight, cameras: Sequence[Camera], index: int, count: int, among: Sequence[int]) -> list[int]:
    """Return up to ``count`` views to compare a view with: the nearest cameras that share sight with it."""
    # Views too near for depth are skipped. The views that share most at the best angles gave fewer depths, and mostly lower
    # PSNR (docs/decisions/013-any-capture.md). Without any, the sampled points may have missed the overlap.
    rest = [j for j in among if j != index]
    overlap, matching = (s[index] for s in sight)
    good = [j for j in rest if matching[j] > 0 and matching[j] >= 0.5 * overlap[j]]
    away = {j: float(np.linalg.norm(cameras[j].center - cameras[index].center)) for j in rest}
    return sorted(good or rest, key=away.get)[:count]


def spread_views(sight: Sight, most: int) -> list[int]:
    """Return up to ``most`` views, in ascending order, chosen to cover as much of the area of all views as possible."""
    # greedy for a submodular sum: at least 1 - 1/e of the optimum (Nemhauser et al. 1978)
    count = len(sight[0])
    if count <= most:
        return list(range(count))
    shared = np.where(np.eye(count, dtype=bool), 1, sight[0])
    covered, taken = np.zeros(count), []
    while len(taken) < most:
        gains = np.maximum(shared - covered[:, None], 0).sum(0).round(9)
        gains[taken] = -1
        taken.append(int(gains.argmax()))
        covered = np.maximum(covered, shared[:, taken[-1]])
    return sorted(taken)


NOISE = (2 / 255) ** 2
"""Variance below which the pattern in a correlation window counts as noise: correlation fades to 0 there."""
EDGE = 0.06
"""Colour step between neighbouring pixels at which the penalty for a jump in depth falls to 1/e."""
UNIT = 4096
"""Integer that stands for cost 1 in cost volumes of 16 bits. Such volumes need half the memory of float32; the first access
to memory takes as long as the computation."""
PLANES_AT_ONCE = 32
"""Number of planes per launch on the GPU; with 16, launches take longer than their work on a large GPU."""


NEAR_COUNT = 4
"""Number of other views with which each view is compared: the nearest that see the same surfaces."""
MAX_VIEWS = 30
"""Largest number of views that are swept: those that together see most of the scene. All others serve only for comparison."""
WINDOW = 7
"""Side of the square in which pixels are correlated [px]; kernels, which add up squares in 32 bits, take 3, 5 or 7."""
SPACING, MAX_PLANES = 0.5, 256
"""Largest step of a match from one plane to the next [px], if the largest number of planes allows it; memory is about 5 bytes
per pixel and plane."""
MAX_PIXELS = 200_000
"""Largest number of pixels of an image; larger ones are swept at a reduced size."""
SMALL_STEP, LARGE_STEP = 0.03, 0.5
"""Penalty for a depth one plane off the neighbouring pixel's (P1), and for any other depth (P2) in a uniform area. P2 is
less across the image's edges, but at least 1.5 P1. The sum of four path costs, each at most 1 + P2, stays below 2^15 in units
of 1 / `UNIT`. Costs are in [0, 1]."""
MAX_ROUND_TRIP = 0.6
"""Largest error [px] when a pixel is projected into another view and back by that view's depth."""
MIN_PARALLAX = 0.5
"""Smallest angle between the two rays [deg]; below it depth is noise."""


def project_inverse(first: Camera, second: Camera, pixels: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """Project pixels [N, 2] at inverse depths [1/u] [N] into the second image; return positions [px] [N, 2], NaN if behind."""
    geometry.check_pinhole(first)
    geometry.check_pinhole(second)
    rotation, translation = geometry.relative_pose(first, second)
    rays = geometry.matmul(homogeneous(pixels), geometry.inverse(first.K).T)
    p = geometry.matmul(geometry.matmul(rays, rotation.T) + inverse[:, None] * translation, second.K.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(p[:, 2:] > 1e-9, p[:, :2] / p[:, 2:], np.nan)


def plane_inverses(
    first: Camera, others: Sequence[Camera], bounds: tuple[float, float], max_planes: int = MAX_PLANES
) -> np.ndarray:
    """Return 8 to ``max_planes`` inverse depths [1/u], evenly spaced and ascending, from the far to the near bound [u]."""
    near, far = bounds
    x, y = np.meshgrid(np.linspace(0, first.width, 5), np.linspace(0, first.height, 5))
    pixels = np.stack([x.ravel(), y.ravel()], 1)
    ladder = np.linspace(1 / far, 1 / near, 17)
    longest = 0.0
    for other in others:
        found = np.stack([project_inverse(first, other, pixels, np.full(len(pixels), w)) for w in ladder])
        inside = (found >= 0).all(-1) & (found[..., 0] < other.width) & (found[..., 1] < other.height)  # False for NaN
        steps = np.linalg.norm(np.diff(found, axis=0), axis=2)[inside[1:] & inside[:-1]]
        longest = max(longest, float(steps.max(initial=0)) * (len(ladder) - 1))
    return np.linspace(1 / far, 1 / near, int(np.clip(np.ceil(longest / SPACING) + 1, 8, max_planes)))


def plane_homography(first: Camera, second: Camera, inverse: float | np.ndarray) -> np.ndarray:
    """Return H [..., 3, 3] from first to second by planes z = 1 / inverse [...], for pixel centres at integers (OpenCV)."""
    geometry.check_pinhole(first)
    geometry.check_pinhole(second)
    rotation, translation = geometry.relative_pose(first, second)
    H = rotation + np.asarray(inverse)[..., None, None] * np.outer(translation, [0, 0, 1])
    back, shift = (np.array([[1, 0, s], [0, 1, s], [0, 0, 1]]) for s in (-0.5, 0.5))
    return _product(_product(back, _product(_product(second.K, H), geometry.inverse(first.K))), shift)


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the products of matrices [..., 3, 3], added up in one order on every processor (`geometry.matmul`)."""
    return a[..., :1] * b[..., :1, :] + a[..., 1:2] * b[..., 1:2, :] + a[..., 2:] * b[..., 2:, :]


def plane_homographies(first: Camera, others: Sequence[Camera], inverses: np.ndarray) -> np.ndarray:
    """Return `plane_homography` of D inverse depths [1/u] and N other cameras, shape [D, N, 3, 3]."""
    start = np.stack([plane_homography(first, o, 0.0) for o in others])
    slope = np.stack([plane_homography(first, o, 1.0) for o in others]) - start
    return start + inverses[:, None, None, None] * slope


def gray_of(view: View) -> np.ndarray:
    """Return the brightness of a view's pixels in [0, 1], float32, shape [H, W], with the weights of ITU-R BT.601."""
    red, green, blue = (view.image[..., i].astype(float) for i in range(3))
    return (0.299 * red + 0.587 * green + 0.114 * blue).astype(np.float32)


def step_limits(colors: np.ndarray, small_step: float = SMALL_STEP, large_step: float = LARGE_STEP) -> np.ndarray:
    """Return P2 of the steps along the first axis of an image [L, B, 3], in units of 1 / `UNIT`, int16, shape [L - 1, B]."""
    red, green, blue = np.moveaxis(np.abs(np.diff(colors, axis=0)), 2, 0)
    largest = np.maximum(np.maximum(red, green), blue)  # six times as fast as max(2)
    jumps = largest.astype(float)  # the rounding of float32's exp depends on the processor
    return np.rint(np.maximum(large_step * np.exp(-jumps / EDGE), 1.5 * small_step) * UNIT).astype(np.int16)


def matching_costs_cpu(view: View, others: Sequence[View], inverses: np.ndarray, window: int = WINDOW) -> Tensor:
    """Return the disagreement of views at D inverse depths [1/u] in units of 1 / `UNIT`, as `plane_costs` does."""
    homographies = plane_homographies(view.camera, [o.camera for o in others], inverses)
    return plane_costs(gray_of(view), [(gray_of(o), o.mask) for o in others], homographies, window, NOISE, UNIT)


def path_costs(costs: Tensor, image: np.ndarray, small_step: float = SMALL_STEP, large_step: float = LARGE_STEP) -> Tensor:
    """Return the sum of the semi-global path costs from four sides, int16 [H, W, D], in units of 1 / `UNIT`."""
    limits = (step_limits(colors, small_step, large_step) for colors in (image, image.swapaxes(0, 1)))
    down, across = (torch.from_numpy(steps.astype(np.int32)).to(costs.device) for steps in limits)
    return scanline_costs(costs, down, across.T, round(small_step * UNIT))


def inverse_depths_cpu(view: View, others: Sequence[View], planes: np.ndarray) -> np.ndarray:
    """Return inverse depths [1/u] of a view, float64, shape [H, W], by sweeping planes against other views."""
    return best_inverses(path_costs(matching_costs_cpu(view, others, planes), view.image), planes)


MAPS = 24
"""Number of float32 maps of a plane that exist while its costs are computed."""


def needed_bytes(view: View, planes: int) -> int:
    """Return the largest device memory [bytes] that `inverse_depths_cuda` takes for a view and ``planes`` planes."""
    return view.camera.width * view.camera.height * (4 * planes + 4 * MAPS * min(planes, PLANES_AT_ONCE))


def matching_costs_cuda(view: View, others: Sequence[View], inverses: np.ndarray, device: torch.device) -> Tensor:
    """Return the costs of `matching_costs_cpu`, without its padding planes, int16, shape [H, W, D], on the device."""

    def box(maps: Tensor) -> Tensor:
        r = WINDOW // 2
        return torch.nn.functional.avg_pool2d(torch.nn.functional.pad(maps, (r, r, r, r), mode="reflect"), WINDOW, 1)

    own, *grays = [torch.from_numpy(gray_of(v))[None, None].to(device) for v in (view, *others)]
    width, height = view.camera.width, view.camera.height
    x = torch.arange(width, dtype=torch.float32, device=device)
    y = torch.arange(height, dtype=torch.float32, device=device)[:, None]
    mean = box(own)
    variance = (box(own * own) - mean * mean).clamp(min=0) + NOISE
    costs = torch.empty(height, width, len(inverses), dtype=torch.int16, device=device)
    # all planes at once, since each copy from the host waits for the device
    to_others = np.stack([plane_homography(view.camera, other.camera, inverses) for other in others])
    homographies = torch.from_numpy(to_others).to(device, torch.float32)[..., None, None]  # [N, D, 3, 3, 1, 1]
    for first in range(0, len(inverses), PLANES_AT_ONCE):
        least, total = None, 0
        for other, gray, planes in zip(others, grays, homographies):
            H = planes[first : first + PLANES_AT_ONCE]
            p = [H[:, i, 0] * x + H[:, i, 1] * y + H[:, i, 2] for i in range(3)]
            sides = (other.camera.width, other.camera.height)
            # with centres as grid_sample has them without align_corners; with it, torch would load cuDNN
            at = torch.stack([(2 * p[i] / p[2] + 1) / n - 1 for i, n in enumerate(sides)], -1)  # [P, H, W, 2]
            # outside is -1, which is less than any colour, also where a pixel is partly outside
            warped = torch.nn.functional.grid_sample((gray + 1).expand(len(H), -1, -1, -1), at, align_corners=False) - 1
            m = box(warped)
            v = (box(warped * warped) - m * m).clamp(min=0) + NOISE
            cost = 0.5 - 0.5 * (box(own * warped) - mean * m) / (variance * v).sqrt()
            votes = warped >= 0
            if other.mask is not None:
                mask = torch.from_numpy(other.mask).to(device, torch.float32).expand(len(H), 1, -1, -1)
                votes &= torch.nn.functional.grid_sample(mask, at, "nearest", align_corners=False) > 0
            cost = torch.where(votes, cost, NEUTRAL)
            total = total + cost
            least = cost if least is None else torch.minimum(least, cost)
        found = (0.5 * least + total * (0.5 / len(others))).clamp(0, 1) * UNIT
        costs[..., first : first + PLANES_AT_ONCE] = found.round()[:, 0].permute(1, 2, 0).to(torch.int16)
    return costs


def best_inverse(costs: Tensor, inverses: np.ndarray) -> Tensor:
    """Return inverse depths [1/u] as `best_inverses` does, float64, shape [H, W], on the device."""
    k = costs.argmin(2, keepdim=True).clamp(1, len(inverses) - 2)
    left, middle, right = (costs.gather(2, k + o).double() for o in (-1, 0, 1))
    bend = left - 2 * middle + right
    offset = torch.where(bend > 1e-9, 0.5 * (left - right) / bend.clamp(min=1e-9), 0).clamp(-1, 1)
    return (inverses[0] + (k + offset) * (inverses[1] - inverses[0]))[..., 0]


@torch.no_grad()
def inverse_depths_cuda(view: View, others: Sequence[View], planes: np.ndarray, device: torch.device) -> Tensor:
    """Return inverse depths [1/u] of a view, float64, [H, W], by sweeping planes against at least one other view."""
    return best_inverse(path_costs(matching_costs_cuda(view, others, planes, device), view.image), planes)


# Plane-sweep depth: agreement with other views at every depth, smoothed along scanlines, then cross-checked.
#
# Poses are known, so a match is sought only along the epipolar line, with one plane per inverse depth (Collins 1996).
# The method is zero-mean normalised correlation over a window, semi-global aggregation (Hirschmüller 2008) and a
# parabola between planes. Depths are kept where the sweep of another view agrees. docs/decisions/007-coarse-start.md
# compares sweeps with optical flow.

CPU = torch.device("cpu")
GPU_FRACTION = 0.25
"""Fraction of a GPU's memory that a sweep may take."""


def _reduced(view: View) -> View:
    """Return the view, resized to at most `MAX_PIXELS` where it is larger."""
    import cv2

    small = geometry.resized(view.camera, min(1.0, (MAX_PIXELS / (view.camera.width * view.camera.height)) ** 0.5))
    if small is view.camera:
        return view
    size, mask = (small.width, small.height), view.mask
    if mask is not None:
        mask = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    return View(view.name, small, cv2.resize(view.image, size, interpolation=cv2.INTER_AREA), mask)


def consistent_depth(views: dict[int, View], inverses: dict[int, np.ndarray], index: int, others: Sequence[int]) -> ViewDepth:
    """Return the depth of one view where it is geometrically consistent with the depth of at least one other view."""
    # a point returns to its pixel by the other view's depth; the sensitivity is the smallest among the consistent views
    own, notes = inverses[index], []
    sensitivity = np.full(own.shape, np.inf)
    for j in others:
        agrees = check_round_trip(
            views[index].camera, views[j].camera, own, inverses[j], sensitivity, most=MAX_ROUND_TRIP, min_parallax=MIN_PARALLAX
        )
        if not agrees.any():
            notes.append(f"no depth agrees with {views[j].name}")
    valid = np.isfinite(sensitivity)
    return ViewDepth(np.where(valid, 1 / own, 0).astype(np.float32), valid, sensitivity.astype(np.float32), tuple(notes))


def _on_gpu(views: Mapping[int, View], planes: Mapping[int, np.ndarray], device: torch.device) -> tuple[bool, list[str]]:
    """Return whether the device sweeps, which a GPU may not be able to, and notes on this."""
    if device.type != "cuda":
        return False, []
    needed = max(needed_bytes(views[i], len(p)) for i, p in planes.items())
    # not by the free memory: a resumed fit must find the same depths again
    if needed > GPU_FRACTION * installed_bytes(device):
        return False, [f"depth is swept on the CPU, since a GPU needs {format_bytes(needed / GPU_FRACTION)} of memory"]
    return min(min(v.image.shape[:2]) for v in views.values()) > WINDOW // 2, []  # torch mirrors no border wider than the image


def _at_size(found: ViewDepth, small: View, view: View, notes: Sequence[str]) -> ViewDepth:
    """Return depth found in a smaller image, resized to the view's own size and without masked pixels."""
    import cv2

    depth, valid, sensitivity = found.depth, found.valid, found.sensitivity
    if small is not view:
        size, scale = (view.camera.width, view.camera.height), small.camera.width / view.camera.width
        notes = [*notes, f"swept at {small.camera.width} x {small.camera.height} px"]
        depth, sensitivity = (cv2.resize(a, size, interpolation=cv2.INTER_NEAREST) for a in (depth, sensitivity * scale))
        valid = cv2.resize(valid.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    if view.mask is not None:
        valid = valid & view.mask
    return ViewDepth(np.where(valid, depth, 0), valid, np.where(valid, sensitivity, np.inf), (*notes, *found.notes))


def sweep_depths(
    views: Sequence[View], bounds: Sequence[tuple[float, float]], device: torch.device = CPU,
    progress: Callable[[int, int], object] = lambda done, total: None, max_planes: int = MAX_PLANES,
) -> list[ViewDepth]:  # fmt: skip
    """Return the depth of every view, at its own size, by sweeping planes against views that see the same surfaces."""
    cameras = [v.camera for v in views]
    sight = shared_sight(cameras, bounds)
    swept = spread_views(sight, MAX_VIEWS)
    others = {i: matching_views(sight, cameras, i, NEAR_COUNT, range(len(views))) for i in swept}
    with single_threaded_opencv():
        small = {i: _reduced(views[i]) for i in sorted({*swept, *(j for o in others.values() for j in o)})}
        planes = {
            i: plane_inverses(small[i].camera, [small[j].camera for j in others[i]], bounds[i], max_planes) for i in swept
        }
        on_gpu, messages = _on_gpu(small, planes, device)
        inverses = {}
        for done, i in enumerate(swept, 1):
            compared = [small[j] for j in others[i]]
            if not compared:
                inverses[i] = np.full(small[i].image.shape[:2], planes[i][0])
            elif on_gpu:
                inverses[i] = inverse_depths_cuda(small[i], compared, planes[i], device)
            else:
                inverses[i] = inverse_depths_cpu(small[i], compared, planes[i])
            progress(done, len(swept))
        # only now, so that a GPU works on one view while the next is prepared
        inverses = {i: t.cpu().numpy() if isinstance(t, Tensor) else t for i, t in inverses.items()}
        note = f"not swept: the {len(swept)} swept views (of {len(views)}) see most of the scene"
        out = [no_depth(v, note, searched=False) for v in views]

        def checked(i: int) -> ViewDepth:
            found = consistent_depth(small, inverses, i, matching_views(sight, cameras, i, NEAR_COUNT, swept))
            return _at_size(found, small[i], views[i], messages if i == swept[0] else ())

        for i, found in zip(swept, in_threads(checked, swept)):
            out[i] = found
    return out
