"""Matches between views: epipolar geometry, optical flow, and the points that they triangulate."""

import functools
import itertools
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch

from warpgs import geometry
from warpgs.errors import DataError, UsageError, expect, explained
from warpgs.files import read_file
from warpgs.onnx import Model
from warpgs.priors.networks import in_threads
from warpgs.scene import Camera, PointCloud, View, ViewDepth

# Depth from optical flow between views with known poses: epipolar lines, checks, and the blending of source views.
#
# After NexusGS (Zheng et al. 2025), with checks that its released code lacks: positive depths in both views, a smallest
# parallax, a position inside the image, and the round trip of the flow. The sensitivity of depth to the match is the
# true derivative. Derivation: docs/flow_epipolar.md.

CPU = torch.device("cpu")
MAX_RESIDUAL = 1.0
"""Largest distance of a match from its epipolar line [px] (NexusGS)."""
MAX_ROUND_TRIP = 1.5
"""Largest distance between a pixel and the end of its round trip by flow [px]."""
MIN_PARALLAX = 0.5
"""Smallest angle between the two rays of a match [deg]; below it depth is noise."""
NEAR_COUNT = 4
"""Number of nearest other views with which each view is matched."""
STEP = 0.5
"""Step along the epipolar line for the central difference of the sensitivity [px]."""

FlowBetween = Callable[[int, int], np.ndarray | None]
"""Flow [px], float32 [H, W, 2], from the pixels of view i to view j, or None."""


def pixel_grid(camera: Camera) -> np.ndarray:
    """Return the pixel centres [px] of an image, float64, shape [H * W, 2], row by row."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return np.stack([x.ravel(), y.ravel()], 1)


def nearest_views(views: Sequence[View], index: int, count: int) -> list[int]:
    """Return the indices of at most ``count`` other views, nearest camera centre first (ties by order)."""
    centers = np.array([v.camera.center for v in views])
    return [int(j) for j in np.argsort(np.linalg.norm(centers - centers[index], axis=1), kind="stable") if j != index][:count]


def homogeneous(pixels: np.ndarray) -> np.ndarray:
    """Return pixels [N, 2] as homogeneous coordinates (x, y, 1), shape [N, 3]."""
    return np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1)


def fundamental(first: Camera, second: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return F [3, 3], and R_st [3, 3] and tau [3] of ``X_second = R_st (X_first + tau)``, of a pair of cameras."""
    geometry.check_pinhole(first)
    geometry.check_pinhole(second)
    R_s, t_s = first.viewmat[:3, :3], first.viewmat[:3, 3]
    R_t, t_t = second.viewmat[:3, :3], second.viewmat[:3, 3]
    R_st = R_t @ R_s.T
    tau = R_st.T @ t_t - t_s
    x, y, z = tau
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.linalg.inv(second.K).T @ R_st @ cross @ np.linalg.inv(first.K), R_st, tau


def epipolar_depth(
    first: Camera, second: Camera, pixels: np.ndarray, matches: np.ndarray, min_parallax: float = MIN_PARALLAX
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return z-depths [u], residuals [px], |dz/dpx| [u/px] and validity, [N] each, of pixels [N, 2] by their matches [N, 2]."""
    # docs/flow_epipolar.md, equations 1 to 6. A residual is the distance of a match from its epipolar line. A depth is valid
    # where both depths are positive, the parallax suffices, and the line's nearest point is in the image; NaN if undefined.
    F, R_st, tau = fundamental(first, second)
    rays = homogeneous(pixels) @ np.linalg.inv(first.K).T
    lines = homogeneous(pixels) @ F.T
    to_first = np.linalg.inv(second.K).T @ R_st
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        lines /= np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
        signed = (lines[:, :2] * matches).sum(1) + lines[:, 2]
        feet = matches - signed[:, None] * lines[:, :2]
        depth, along, sine = _ray_lengths(rays, homogeneous(feet) @ to_first, tau)
        direction = np.stack([-lines[:, 1], lines[:, 0]], 1)
        ahead, ahead_along, _ = _ray_lengths(rays, homogeneous(feet + STEP * direction) @ to_first, tau)
        behind, behind_along, _ = _ray_lengths(rays, homogeneous(feet - STEP * direction) @ to_first, tau)
        sensitivity = np.abs(ahead - behind) / (2 * STEP)
        inside = (feet >= 0).all(1) & (feet[:, 0] < second.width) & (feet[:, 1] < second.height)
        valid = (depth > 0) & (along > 0) & (sine > np.sin(np.radians(min_parallax))) & inside & np.isfinite(depth)
        steady = (ahead > 0) & (behind > 0) & (ahead_along > 0) & (behind_along > 0) & np.isfinite(sensitivity)
    return depth, np.abs(signed), np.where(steady, sensitivity, np.inf), valid


def _ray_lengths(rays: np.ndarray, others: np.ndarray, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the signed lengths z and mu in ``z ray + tau = mu other`` and the sine of the rays' angle, shape [N] each."""
    normal = np.cross(rays, others)
    square = (normal**2).sum(1)
    z = (np.cross(others, tau) * normal).sum(1) / square
    # cross with the ray: mu (other x ray) = tau x ray
    mu = -(np.cross(tau, rays) * normal).sum(1) / square
    return z, mu, np.sqrt(square / ((rays**2).sum(1) * (others**2).sum(1)))


def round_trip(matches: np.ndarray, pixels: np.ndarray, back: np.ndarray) -> np.ndarray:
    """Return the distance [px] from each pixel to its match moved by the flow ``back`` [H, W, 2], shape [N]; inf outside."""
    import cv2

    height, width = back.shape[:2]
    # OpenCV samples at whole numbers for pixel centres
    at = np.nan_to_num(matches - 0.5, nan=-1e6, posinf=-1e6, neginf=-1e6).astype(np.float32)[:, None]
    # remap takes at most 32767 rows
    parts = [at[k : k + 30000] for k in range(0, len(at), 30000)]
    flow = [cv2.remap(back, p, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for p in parts]
    flow = np.concatenate(flow)[:, 0] if parts else np.zeros((0, 2))
    inside = (matches >= 0).all(1) & (matches[:, 0] < width) & (matches[:, 1] < height)
    distance = np.linalg.norm(matches + flow - pixels, axis=1)
    return np.where(inside & np.isfinite(distance), distance, np.inf)


def least_sensitive(depths: np.ndarray, sensitivities: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return depths [N] [u] and sensitivities [N] [u/px] of the best candidates [S, N]; 0 and inf if none is valid."""
    # a valid candidate of infinite sensitivity still sorts before an invalid one; of equal ones the nearest view's is taken
    best = np.argmin(np.where(valid, np.minimum(sensitivities, np.finfo(float).max), np.inf), axis=0)[None]
    depth, sensitivity = (np.take_along_axis(a, best, 0)[0] for a in (depths, sensitivities))
    some = valid.any(0)
    return np.where(some, depth, 0), np.where(some, sensitivity, np.inf)


def no_depth(view: View, *notes: str, searched: bool = True) -> ViewDepth:
    """Return the depth of a view of which none is known."""
    shape = view.image.shape[:2]
    return ViewDepth(np.zeros(shape, np.float32), np.zeros(shape, bool), np.full(shape, np.inf, np.float32), notes, searched)


def flow_depth(views: Sequence[View], index: int, flow: FlowBetween) -> ViewDepth:
    """Return the depth of one view by flow to its nearest other views; valid nowhere if no flow passes the checks."""
    view, pixels = views[index], pixel_grid(views[index].camera)
    candidates, notes = [], []
    for j in nearest_views(views, index, NEAR_COUNT):
        there, back = flow(index, j), flow(j, index)
        if there is None:
            notes.append(f"no flow to {views[j].name}")
            continue
        matches = pixels + there.reshape(-1, 2)
        depth, residual, sensitivity, good = epipolar_depth(view.camera, views[j].camera, pixels, matches)
        good &= residual < MAX_RESIDUAL
        if back is None:
            notes.append(f"no flow from {views[j].name}, so the flow to it was not checked by a round trip")
        else:
            good &= round_trip(matches, pixels, back) < MAX_ROUND_TRIP
        if not good.any():
            notes.append(f"no flow to {views[j].name} survives the checks")
        candidates.append((depth, sensitivity, good))
    if not candidates:
        return no_depth(view, *notes)
    shape = view.image.shape[:2]
    depth, sensitivity = (a.reshape(shape) for a in least_sensitive(*(np.stack(c) for c in zip(*candidates))))
    valid = depth > 0 if view.mask is None else (depth > 0) & view.mask
    depth, sensitivity = np.where(valid, depth, 0), np.where(valid, sensitivity, np.inf)
    return ViewDepth(depth.astype(np.float32), valid, sensitivity.astype(np.float32), tuple(notes))


MATCH_RATIO = 0.8
"""Largest ratio of the distances to the best and to the second match (Lowe's test)."""
BLOCK = 32
"""Number of descriptors that are compared with as many at a time: so few that BLAS starts no threads beside our own."""
MAX_ERROR = 2.0
"""Largest reprojection error in either view [px]."""
MIN_ANGLE = 1.0
"""Smallest angle between the two rays [deg]; below it depth is noise."""
MAX_PAIRS = 30
"""Largest number of pairs of views that are matched, nearest first."""
MANY, AT_ONCE = 2**30, 2**24
"""Number of comparisons of descriptors from which a GPU does them, and number that it does at a time."""
PIXELS_AT_ONCE = 16_000_000
"""Number of pixels of the images whose features are found at a time; SIFT takes about 250 bytes of memory a pixel."""


Features = tuple[np.ndarray, np.ndarray | None]
"""SIFT features of one view: positions [px], pixel centres at +0.5, shape [N, 2], and descriptors, uint8 [N, 128]; None without
features."""


def sift_features(view: View, max_pixels: int | None = None, most: int = 0) -> Features:
    """Find the SIFT features of a view (Lowe 2004) within its mask, at most ``most`` of them unless that is 0."""
    import cv2

    gray = cv2.cvtColor((view.image * 255).round().astype(np.uint8), cv2.COLOR_RGB2GRAY)
    mask = None if view.mask is None else view.mask.astype(np.uint8) * 255
    scale = np.ones(2)
    if max_pixels is not None and gray.size > max_pixels:
        height, width = gray.shape
        shrink = (max_pixels / gray.size) ** 0.5
        size = (max(1, int(width * shrink)), max(1, int(height * shrink)))
        scale = np.array([width, height]) / size
        gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
        mask = None if mask is None else cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST)
    keypoints, descriptors = cv2.SIFT_create(nfeatures=most).detectAndCompute(gray, mask)
    # OpenCV's pixel centres are at whole numbers
    pixels = (np.array([k.pt for k in keypoints]).reshape(-1, 2) + 0.5) * scale
    return pixels, None if descriptors is None else descriptors.astype(np.uint8)


# Whole numbers below 2^24 are exact in float32, in any order of additions: squared distances are the same on every device. A
# nearest descriptor that is not alone fails Lowe's test, whichever of the equal ones is found.


def _two_nearest(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the nearest of the second descriptors to each first one [N], and squared distances to the nearest two [2, N]."""
    others = np.zeros((-(-len(second) // BLOCK), BLOCK, second.shape[1]), np.float32)
    others.reshape(-1, second.shape[1])[: len(second)] = second
    others_squared = np.square(others).sum(-1).ravel()
    others_squared[len(second) :] = np.inf
    found = []
    for start in range(0, len(first), BLOCK):
        block = first[start : start + BLOCK].astype(np.float32)
        products = np.matmul(-2 * block, others.transpose(0, 2, 1))  # a block of the others after the other
        squares, rows = products.transpose(1, 0, 2).reshape(len(block), -1) + others_squared, np.arange(len(block))
        best = squares.argmin(1)
        nearest = squares[rows, best]
        squares[rows, best] = np.inf
        found.append((best, np.stack([nearest, squares.min(1)]) + np.square(block).sum(-1)))
    return np.concatenate([best for best, _ in found]), np.concatenate([squares for _, squares in found], 1)


def _two_nearest_cuda(first: np.ndarray, second: np.ndarray, device: torch.device) -> tuple[np.ndarray, np.ndarray]:
    """Return what `_two_nearest` does, on a GPU."""
    a, b = (torch.from_numpy(d).to(device, torch.float32) for d in (first, second))
    parts, others = a.split(max(1, AT_ONCE // len(b))), b.square().sum(1)
    found = [torch.addmm(others, part, b.T, alpha=-2).topk(2, largest=False) for part in parts]
    squares = torch.cat([values for values, _ in found]) + a.square().sum(1, keepdim=True)
    return torch.cat([ids[:, 0] for _, ids in found]).cpu().numpy(), squares.T.cpu().numpy()


def _ratio_matches(first: np.ndarray | None, second: np.ndarray | None, device: torch.device = CPU) -> np.ndarray:
    """Return the rows [N, 2] of descriptors, uint8 [K, 128], that match by Lowe's test."""
    if first is None or second is None or min(len(first), len(second)) < 2:
        return np.zeros((0, 2), int)
    best, squares = _two_nearest_cuda(first, second, device) if device.type == "cuda" else _two_nearest(first, second)
    distances = np.sqrt(squares).astype(float)
    matched = np.flatnonzero(distances[0] < MATCH_RATIO * distances[1])
    return np.stack([matched, best[matched]], 1)


def agreeing_matches(
    a: View, b: View, first: Features, second: Features, min_angle: float = MIN_ANGLE, device: torch.device = CPU
) -> tuple[np.ndarray, np.ndarray, int]:
    """Match two views' features; return rows [N, 2] and points [N, 3] [u] of those that agree with the poses; number of all."""
    ids = _ratio_matches(first[1], second[1], device)
    found, good = _triangulate(a, b, first[0][ids[:, 0]], second[0][ids[:, 1]], min_angle)
    return ids[good], found[good], len(ids)


def _triangulate(a: View, b: View, at_a: np.ndarray, at_b: np.ndarray, min_angle: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the points [u] midway between the rays of each match [N, 3], and True where they pass the checks [N]."""
    origins = [v.camera.center for v in (a, b)]
    rays = []
    for view, pixels in ((a, at_a), (b, at_b)):
        far = geometry.back_project(view.camera, pixels, np.ones(len(pixels))) - view.camera.center
        rays.append(far / np.linalg.norm(far, axis=1, keepdims=True))
    baseline = origins[1] - origins[0]
    cosine = (rays[0] * rays[1]).sum(1)
    sine2 = np.maximum(1 - cosine**2, 1e-12)
    along = [geometry.matmul(r, baseline) for r in rays]
    s = (along[0] - cosine * along[1]) / sine2
    t = (cosine * along[0] - along[1]) / sine2
    points = 0.5 * (origins[0] + s[:, None] * rays[0] + origins[1] + t[:, None] * rays[1])
    good = (s > 0) & (t > 0) & (sine2 > np.sin(np.radians(min_angle)) ** 2)
    for view, pixels in ((a, at_a), (b, at_b)):
        projected, z = geometry.project_points(view.camera, points)
        with np.errstate(over="ignore"):  # points beside the camera are infinitely far from their pixels
            good &= (z > 0) & (np.linalg.norm(projected - pixels, axis=1) < MAX_ERROR)
    return points, good


def triangulate_matches(views: list[View], device: Callable[[], torch.device] = lambda: CPU) -> PointCloud:
    """Return points [u] of SIFT matches (Lowe 2004) that agree with the known poses, with the pixels' colours.

    Many features are compared on the ``device``, if it is a GPU; the result is the same.
    """
    centers = [v.camera.center for v in views]
    pairs = sorted(itertools.combinations(range(len(views)), 2), key=lambda p: np.linalg.norm(centers[p[0]] - centers[p[1]]))
    pairs = pairs[:MAX_PAIRS]
    chosen = sorted({i for pair in pairs for i in pair})
    most = max(1, PIXELS_AT_ONCE // max((v.camera.width * v.camera.height for v in views), default=1))
    features = dict(zip(chosen, in_threads(lambda i: sift_features(views[i]), chosen, most=most)))
    own = device() if sum(len(features[i][0]) * len(features[j][0]) for i, j in pairs) > MANY else CPU

    def match(pair: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, int]:
        return agreeing_matches(*(views[i] for i in pair), *(features[i] for i in pair), device=own)

    matched = in_threads(match, pairs)
    points, colors = [np.zeros((0, 3))], [np.zeros((0, 3), np.float32)]
    for (i, _), (ids, found, _) in zip(pairs, matched):
        at = features[i][0][ids[:, 0]].astype(int)
        points.append(found)
        colors.append(views[i].image[at[:, 1], at[:, 0]])
    return PointCloud(np.concatenate(points), np.concatenate(colors))


# Optical flow between ordered pairs of views: OpenCV's methods, a folder of .flo files, or a network as an ONNX file.
#
# Whatever the source, flow is float32 [H, W, 2] in pixels of the first view's image: a pixel (x, y) is found at (x + u,
# y + v) in the second, for pixel centres at +0.5 in both. NaN means unknown.

KINDS = ("dis", "deepflow", "sparse")
FLO_MAGIC = np.float32(202021.25)
"""First four bytes of a .flo file (Baker et al. 2011, vision.middlebury.edu/flow)."""
MIN_UNKNOWN = 1e9
"""Flow with a component of at least this magnitude is unknown (Baker et al. 2011)."""
MAX_SIDE = 1 << 15
MAX_FLOW_PIXELS = 100_000_000
"""Largest number of pixels of a .flo file that is read."""
LINE_DISTANCE = 2.0
"""Largest distance of a sparse match from its epipolar line [px]."""
MIN_SPARSE = 16
"""Smallest number of matches from which flow is interpolated."""
NET_STRIDE = 8
"""Both image sides are multiples of this [px] for networks such as RAFT."""


def read_flo(path: Path) -> np.ndarray:
    """Return the flow of a Middlebury file, float32, shape [H, W, 2]; NaN where unknown."""
    raw = read_file(path, most=12 + 8 * MAX_FLOW_PIXELS, fix="check the path and its permissions", what="flow ")
    with explained(f"{path}: not a Middlebury .flo file", "write the flow again", ValueError):
        expect(len(raw) >= 12 and np.frombuffer(raw, "<f4", 1)[0] == FLO_MAGIC, "its first number must be 202021.25")
        width, height = (int(v) for v in np.frombuffer(raw, "<i4", 2, 4))
        expect(1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE, f"{width} x {height} px; sides must be 1 to {MAX_SIDE}")
        expect(len(raw) == 12 + 8 * width * height, f"its {len(raw)} bytes are not {width} x {height} px")
    flow = np.frombuffer(raw, "<f4", offset=12).reshape(height, width, 2)
    return np.where((np.abs(flow) < MIN_UNKNOWN).all(2, keepdims=True), flow, np.float32(np.nan)).astype(np.float32)


def resize_flow(flow: np.ndarray, width: int, height: int, second: tuple[int, int] | None = None) -> np.ndarray:
    """Return flow [h, w, 2] [px] at another image size, [height, width, 2]; ``second`` is the second image's new size."""
    import cv2

    h, w = flow.shape[:2]
    if (w, h) == (width, height) == (second or (width, height)):
        return flow
    # in positions, not offsets, so that images of two sizes are handled correctly
    x, y = np.meshgrid((np.arange(width) + 0.5) * w / width, (np.arange(height) + 0.5) * h / height)
    at = np.stack([x, y], 2)
    found = at + cv2.remap(flow, (at - 0.5).astype(np.float32), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    to_width, to_height = second or (width, height)
    return (found * [to_width / w, to_height / h] - at * [width / w, height / h]).astype(np.float32)


def flo_names(views: Sequence[View], i: int, j: int) -> list[str]:
    """Return the names of the file of flow from view i to j: ``A-to-B.flo``, then NexusGS's ``A_i_j.flo``."""
    a, b = (Path(views[k].name) for k in (i, j))
    order = sorted(range(len(views)), key=lambda k: views[k].name)
    ij = f"{order.index(i)}_{order.index(j)}"
    return [f"{a.stem}-to-{b.stem}.flo", f"{a.stem}_{ij}.flo", f"{a.name}_{ij}.flo"]


def _from_folder(folder: Path, views: Sequence[View]) -> FlowBetween:
    names = itertools.chain.from_iterable(flo_names(views, *p) for p in itertools.permutations(range(len(views)), 2))
    if not any((folder / n).is_file() for n in names):
        raise DataError(f"{folder}: no .flo files, such as {flo_names(views, 0, len(views) - 1)[0]}; give their folder")

    def between(i: int, j: int) -> np.ndarray | None:
        for name in flo_names(views, i, j):
            if (folder / name).is_file():
                a, b = views[i].camera, views[j].camera
                return resize_flow(read_flo(folder / name), a.width, a.height, (b.width, b.height))
        return None

    return between


def _gray(view: View) -> np.ndarray:
    import cv2

    return cv2.cvtColor((view.image * 255).round().clip(0, 255).astype(np.uint8), cv2.COLOR_RGB2GRAY)


def _same_size(views: Sequence[View], i: int, j: int, compute: Callable[[View, View], np.ndarray | None]) -> np.ndarray | None:
    """Return flow by a method that needs both images at one size: the second is resized to the first's size."""
    import cv2

    first, second = views[i], views[j]
    a, b = first.camera, second.camera
    if (a.width, a.height) != (b.width, b.height):
        second = View(second.name, b, cv2.resize(second.image, (a.width, a.height), interpolation=cv2.INTER_AREA))
    flow = compute(first, second)
    return flow if flow is None else resize_flow(flow, a.width, a.height, (b.width, b.height))


def _classic(kind: str) -> Callable[[View, View], np.ndarray]:
    import cv2

    if kind == "deepflow":
        method = cv2.optflow.createOptFlow_DeepFlow()
    else:
        method = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        # down to full size with larger patches: half the depth error of the preset on wide baselines, a tenth of a second
        method.setFinestScale(0)
        method.setPatchSize(12)
        method.setPatchStride(4)
        method.setGradientDescentIterations(50)
        method.setVariationalRefinementIterations(10)
    return lambda first, second: method.calc(_gray(first), _gray(second), None)


def _sparse(views: Sequence[View]) -> FlowBetween:
    """Return a function for the flow from SIFT matches near epipolar lines, interpolated along edges (Revaud et al. 2015)."""
    import cv2

    sift = cv2.SIFT_create(contrastThreshold=0.01)
    features = []
    for view in views:
        keypoints, descriptors = sift.detectAndCompute(_gray(view), None)
        features.append((np.array([k.pt for k in keypoints], np.float32).reshape(-1, 2), descriptors))

    def between(i: int, j: int) -> np.ndarray | None:
        (a, da), (b, db) = features[i], features[j]
        ids = _ratio_matches(da, db)
        a, b = a[ids[:, 0]], b[ids[:, 1]]
        # OpenCV's pixel centres are at whole numbers
        lines = homogeneous(a + 0.5) @ fundamental(views[i].camera, views[j].camera)[0].T
        with np.errstate(divide="ignore", invalid="ignore"):
            off = np.abs((lines[:, :2] * (b + 0.5)).sum(1) + lines[:, 2]) / np.linalg.norm(lines[:, :2], axis=1)
        a, b = a[off < LINE_DISTANCE], b[off < LINE_DISTANCE]
        # a keypoint with two directions appears twice
        once = np.unique(a.round(), axis=0, return_index=True)[1]
        a, b = np.ascontiguousarray(a[once]), np.ascontiguousarray(b[once])
        if len(a) < MIN_SPARSE:
            return None
        images = [cv2.cvtColor(_gray(views[k]), cv2.COLOR_GRAY2BGR) for k in (i, j)]
        interpolator = cv2.ximgproc.createEdgeAwareInterpolator()
        interpolator.setK(min(128, len(a) - 1))
        return interpolator.interpolate(images[0], a, images[1], b)

    return between


def _network(path: Path) -> Callable[[View, View], np.ndarray]:
    """Return a function for the flow by a network of two images [1, 3, h, w]; its last output [1, 2, h, w] is used."""
    import cv2

    network = Model(path)
    shapes = [shape for _, _, shape in network.inputs]
    if len(shapes) != 2 or any(len(shape) != 4 for shape in shapes):
        raise DataError(f"{path}: has inputs of {shapes}, but a flow network takes two images [1, 3, h, w]; export it again")
    fixed = [n if isinstance(n, int) else 0 for n in shapes[0][2:]]

    def compute(first: View, second: View) -> np.ndarray:
        h, w = first.image.shape[:2]
        size = (fixed[1] or -(-w // NET_STRIDE) * NET_STRIDE, fixed[0] or -(-h // NET_STRIDE) * NET_STRIDE)
        tensors = [
            (cv2.resize(v.image, size, interpolation=cv2.INTER_LINEAR) * 255.0).astype(np.float32).transpose(2, 0, 1)
            for v in (first, second)
        ]
        found = network.outputs_of(*(t[None] for t in tensors))
        if not (flows := [f for f in found if np.shape(f) == (1, 2, size[1], size[0])]):
            shapes = [np.shape(f) for f in found]
            raise DataError(f"{path}: none of {shapes} is a flow [1, 2, {size[1]}, {size[0]}]; export it upsampled")
        return resize_flow(np.ascontiguousarray(flows[-1][0].transpose(1, 2, 0), dtype=np.float32), w, h)

    return compute


def flow_between(views: Sequence[View], kind: str) -> FlowBetween:
    """Return a function of (i, j) for the flow [H, W, 2] [px] of a pair of views, or None; pairs are computed once."""
    path = Path(kind)
    if kind == "sparse":
        return functools.cache(_sparse(views))
    if kind not in KINDS and path.is_dir():
        return functools.cache(_from_folder(path, views))
    if kind in KINDS:
        method = _classic(kind)
    elif path.suffix == ".onnx" and path.is_file():
        method = _network(path)
    else:
        raise UsageError(f"flow {kind!r} is none of {', '.join(KINDS)}, no folder of .flo files, no .onnx file; check the path")
    return functools.cache(lambda i, j: _same_size(views, i, j, method))
