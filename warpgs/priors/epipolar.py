"""Depth from optical flow between views with known poses: epipolar lines, checks, and the blending of source views.

After NexusGS (Zheng et al. 2025), with checks that its released code lacks: positive depths in both views, a smallest parallax,
a position inside the image, and the round trip of the flow. The sensitivity of depth to the match is the true derivative.
Derivation: docs/flow_epipolar.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from warpgs.errors import UsageError
from warpgs.geometry import check_pinhole
from warpgs.scene import Camera, View, ViewDepth

BLENDS = ("least_sensitive", "nearest_first", "mean_valid", "inverse_sensitivity")
STEP = 0.5
"""Step along the epipolar line for the central difference of the sensitivity [px]."""

FlowBetween = Callable[[int, int], np.ndarray | None]
"""Flow [px], float32 [H, W, 2], from the pixels of view i to view j, or None."""


@dataclass(frozen=True)
class EpipolarConfig:
    """Settings of the checks on matches, and of the blending of depths."""

    max_residual: float = 1.0
    """Largest distance of a match from its epipolar line [px] (NexusGS)."""
    max_round_trip: float = 1.5
    """Largest distance between a pixel and the end of its round trip by flow [px]; infinity switches the check off."""
    min_parallax: float = 0.5
    """Smallest angle between the two rays of a match [deg]; below it depth is noise."""
    near_count: int = 4
    """Number of nearest other views with which each view is matched."""
    blend: str = "least_sensitive"
    """least_sensitive (as in the paper on NexusGS), nearest_first (as in its code), mean_valid or inverse_sensitivity."""

    def __post_init__(self):
        if self.blend not in BLENDS:
            raise UsageError(f"blend {self.blend!r} is not one of {', '.join(BLENDS)}")
        for name in ("max_residual", "max_round_trip", "min_parallax"):
            if not getattr(self, name) > 0:
                raise UsageError(f"{name.replace('_', '-')} must be above 0, not {getattr(self, name)}")
        if self.near_count < 1:
            raise UsageError(f"near-count must be at least 1, not {self.near_count}")


@dataclass(frozen=True)
class PairDepth:
    """Depths of N pixels of a view from their matches in a second view."""

    depth: np.ndarray
    """z-depth in the first view [u], float64, shape [N]; NaN if undefined."""
    residual: np.ndarray
    """Distance of the match from the epipolar line [px], shape [N]."""
    sensitivity: np.ndarray
    """|dz/dpx| [u/px], shape [N]; infinite where a shift by half a pixel moves the point behind a camera or to infinity."""
    valid: np.ndarray
    """True where both depths are positive, the parallax suffices, the depth is finite, and the epipolar line's point nearest to
    the match is in the second image."""


def pixel_grid(camera: Camera) -> np.ndarray:
    """Return the pixel centres [px] of an image, float64, shape [H * W, 2], row by row."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return np.stack([x.ravel(), y.ravel()], 1)


def nearest_views(views: Sequence[View], index: int, count: int) -> list[int]:
    """Return the indices of at most ``count`` other views, nearest camera centre first (ties by order)."""
    centers = np.array([v.camera.center for v in views])
    distances = np.linalg.norm(centers - centers[index], axis=1)
    return [int(j) for j in np.argsort(distances, kind="stable") if j != index][:count]


def homogeneous(pixels: np.ndarray) -> np.ndarray:
    """Return pixels [N, 2] as homogeneous coordinates (x, y, 1), shape [N, 3]."""
    return np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1)


def fundamental(first: Camera, second: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the fundamental matrix F [3, 3], the rotation R_st [3, 3] and the translation tau [3] of a pair of cameras.

    ``F (x, y, 1)`` is the epipolar line, in the second image, of pixel (x, y) of the first. ``X_second = R_st (X_first +
    tau)``: -tau is the second camera's centre in the frame of the first.

    Raises:
        UsageError: A camera is not a pinhole.
    """
    check_pinhole(first)
    check_pinhole(second)
    R_s, t_s = first.viewmat[:3, :3], first.viewmat[:3, 3]
    R_t, t_t = second.viewmat[:3, :3], second.viewmat[:3, 3]
    R_st = R_t @ R_s.T
    tau = R_st.T @ t_t - t_s
    x, y, z = tau
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.linalg.inv(second.K).T @ R_st @ cross @ np.linalg.inv(first.K), R_st, tau


def epipolar_depth(
    first: Camera, second: Camera, pixels: np.ndarray, matches: np.ndarray, min_parallax: float = 0.5
) -> PairDepth:
    """Return depths of pixels of the first view from their matches in the second (docs/flow_epipolar.md, equations 1 to 6).

    Args:
        first: Camera whose pixels get a depth.
        second: Camera of the matches.
        pixels: Positions in the first image [px], shape [N, 2].
        matches: Position of each pixel in the second image [px], shape [N, 2]; NaN where there is no match.
        min_parallax: Smallest angle between the rays [deg].

    Returns:
        Depth, residual, sensitivity and validity of N pixels; a match off its line is replaced by the nearest point of the
        line. Without a baseline nothing is valid.
    """
    F, R_st, tau = fundamental(first, second)
    rays = homogeneous(pixels) @ np.linalg.inv(first.K).T
    lines = homogeneous(pixels) @ F.T
    to_first = np.linalg.inv(second.K).T @ R_st
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        lines /= np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
        signed = (lines[:, :2] * matches).sum(1) + lines[:, 2]
        feet = matches - signed[:, None] * lines[:, :2]
        depth, along, sine = _triangulate(rays, homogeneous(feet) @ to_first, tau)
        direction = np.stack([-lines[:, 1], lines[:, 0]], 1)
        ahead, ahead_along, _ = _triangulate(rays, homogeneous(feet + STEP * direction) @ to_first, tau)
        behind, behind_along, _ = _triangulate(rays, homogeneous(feet - STEP * direction) @ to_first, tau)
        sensitivity = np.abs(ahead - behind) / (2 * STEP)
        inside = (feet >= 0).all(1) & (feet[:, 0] < second.width) & (feet[:, 1] < second.height)
        valid = (depth > 0) & (along > 0) & (sine > np.sin(np.radians(min_parallax))) & inside & np.isfinite(depth)
        steady = (ahead > 0) & (behind > 0) & (ahead_along > 0) & (behind_along > 0) & np.isfinite(sensitivity)
    return PairDepth(depth, np.abs(signed), np.where(steady, sensitivity, np.inf), valid)


def _triangulate(rays: np.ndarray, others: np.ndarray, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the signed lengths z and mu in ``z ray + tau = mu other`` and the sine of the rays' angle, shape [N] each."""
    normal = np.cross(rays, others)
    square = (normal**2).sum(1)
    z = (np.cross(others, tau) * normal).sum(1) / square
    # cross with the ray: mu (other x ray) = tau x ray
    mu = -(np.cross(tau, rays) * normal).sum(1) / square
    sine = np.sqrt(square / ((rays**2).sum(1) * (others**2).sum(1)))
    return z, mu, sine


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


def blend(depths: np.ndarray, sensitivities: np.ndarray, valid: np.ndarray, mode: str) -> tuple[np.ndarray, np.ndarray]:
    """Return one depth and sensitivity per pixel from the candidates of S source views.

    Args:
        depths: Candidates [u], shape [S, N], nearest source first.
        sensitivities: |dz/dpx| of each candidate [u/px], at least 0, shape [S, N].
        valid: True where a candidate passed the checks, shape [S, N].
        mode: least_sensitive takes the candidate with the smallest |dz/dpx|, on ties the nearest source's; nearest_first takes
            the first valid one; mean_valid the mean; inverse_sensitivity the mean weighted by 1 / |dz/dpx|.

    Returns:
        Depths [u], shape [N], 0 where no candidate is valid; and sensitivities [u/px], shape [N], infinite there.

    Raises:
        UsageError: The mode is unknown.
    """
    if mode not in BLENDS:
        raise UsageError(f"blend {mode!r} is not one of {', '.join(BLENDS)}")
    some = valid.any(0)
    if mode in ("least_sensitive", "nearest_first"):
        # a valid candidate of infinite sensitivity still sorts before an invalid one
        rank = np.minimum(sensitivities, np.finfo(float).max) if mode == "least_sensitive" else np.zeros(depths.shape)
        best = np.argmin(np.where(valid, rank, np.inf), axis=0)[None]
        depth, sensitivity = (np.take_along_axis(a, best, 0)[0] for a in (depths, sensitivities))
    else:
        weights = valid.astype(float)
        if mode == "inverse_sensitivity":
            weights = np.where(valid, 1 / np.clip(sensitivities, 1e-12, 1e12), 0)
        total = np.where(some, weights.sum(0), 1)
        depth = (weights * np.where(valid, depths, 0)).sum(0) / total
        finite = np.minimum(sensitivities, 1e12)
        sensitivity = (weights * np.where(valid, finite, 0)).sum(0) / total
    return np.where(some, depth, 0), np.where(some, sensitivity, np.inf)


def flow_depth(views: Sequence[View], index: int, flow: FlowBetween, config: EpipolarConfig) -> ViewDepth:
    """Return the depth of one view by flow to its nearest other views.

    Args:
        views: All views.
        index: Index of the view that gets a depth.
        flow: Function that gives the flow of an ordered pair.
        config: Checks and blending.

    Returns:
        The depth; valid nowhere, with a note, if no flow passes the checks.
    """
    view = views[index]
    shape = view.image.shape[:2]
    pixels = pixel_grid(view.camera)
    candidates, notes = [], []
    for j in nearest_views(views, index, config.near_count):
        there = flow(index, j)
        if there is None:
            notes.append(f"no flow to {views[j].name}")
            continue
        matches = pixels + there.reshape(-1, 2)
        pair = epipolar_depth(view.camera, views[j].camera, pixels, matches, config.min_parallax)
        good = pair.valid & (pair.residual < config.max_residual)
        if np.isfinite(config.max_round_trip):
            back = flow(j, index)
            if back is None:
                notes.append(f"no flow from {views[j].name}, so the flow to it was not checked by a round trip")
            else:
                good &= round_trip(matches, pixels, back) < config.max_round_trip
        if not good.any():
            notes.append(f"no flow to {views[j].name} survives the checks")
        candidates.append((pair.depth, pair.sensitivity, good))
    if not candidates:
        candidates = [(np.zeros(len(pixels)), np.full(len(pixels), np.inf), np.zeros(len(pixels), bool))]
    depth, sensitivity = blend(*(np.stack(c) for c in zip(*candidates)), config.blend)
    valid = depth > 0
    if view.mask is not None:
        valid &= view.mask.ravel()
    return ViewDepth(
        np.where(valid, depth, 0).astype(np.float32).reshape(shape),
        valid.reshape(shape),
        np.where(valid, sensitivity, np.inf).astype(np.float32).reshape(shape),
        tuple(notes),
    )
