"""A small ray caster in numpy: shapes with smooth solid textures under one soft light, without OpenGL and without meshes.

With it the demo scene needs no download and no graphics driver. Every shape computes, in its own frame, the first hit of a ray
and the normal there, and has a bounding sphere. So an image, the exact depth of a pixel and the visibility of a point all come
from the same intersection code. Shading is diffuse: a surface point has one colour from all directions.

Axes as in an OpenCV camera: +x right, +y down, +z away from the viewer. Lengths in scene units [u].
"""

import abc
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from warpgs.geometry import matmul

BAND_RAYS = 40_000
"""Number of rays cast at once: the working set of a band stays in the second-level cache."""
Texture = Callable[[np.ndarray], np.ndarray]
"""Albedo [N, 3] in [0, 1] at local positions [N, 3] [u]."""
Vector = tuple[float, float, float]


class Shape(abc.ABC):
    """A textured shape at a place; subclasses give its geometry in the local frame ``x_local = R^T (x - center)``.

    ``radius`` is that of the bounding sphere around ``center`` [u], infinite without one. ``shading`` is the radius of the
    sphere that casts the shadow of the shape, divided by ``radius``; 0 for thin shapes, which cast no shadow, because a
    sphere's shadow would be too large.
    """

    def __init__(
        self, center: Vector, texture: Texture, rotation: np.ndarray | None = None, shading: float = 0.8, radius: float = np.inf
    ):
        self.center, self.texture, self.shading, self.radius = center, texture, shading, radius
        self.rotation = np.eye(3) if rotation is None else rotation  # world_from_local

    def local(self, x: np.ndarray) -> np.ndarray:
        """Return world positions [u], shape [N, 3], in the local frame."""
        return matmul(x - np.asarray(self.center, x.dtype), self.rotation.astype(x.dtype))

    @abc.abstractmethod
    def hit(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        """Return distances [N] [u] from a local origin [3] along unit directions [N, 3] to the first hit; inf for none."""

    @abc.abstractmethod
    def normal(self, p: np.ndarray) -> np.ndarray:
        """Return outward unit normals in the local frame at local surface positions ``p``; both shape [N, 3]."""


class Plane(Shape):
    """The plane through ``center`` with local normal -z, seen from the side of the normal."""

    def hit(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        """See ``Shape.hit``."""
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -o[2] / d[:, 2]
        return np.where(t > 0, t, np.inf).astype(d.dtype)

    def normal(self, p: np.ndarray) -> np.ndarray:
        """See ``Shape.normal``."""
        return np.broadcast_to(np.array([0, 0, -1], p.dtype), p.shape)


class Sphere(Shape):
    """A sphere of radius ``size`` [u]."""

    def __init__(self, *place, size: float, **more):
        super().__init__(*place, radius=size, **more)
        self.size = size

    def hit(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        """See ``Shape.hit``."""
        b = matmul(d, o)
        root = b * b - (matmul(o, o) - self.size**2)
        t = -b - np.sqrt(np.maximum(root, 0))
        return np.where((root > 0) & (t > 0), t, np.inf).astype(d.dtype)

    def normal(self, p: np.ndarray) -> np.ndarray:
        """See ``Shape.normal``."""
        return p / np.linalg.norm(p, axis=1, keepdims=True)


class Box(Shape):
    """A box with edges along the local axes; ``half`` are half their lengths [u]."""

    def __init__(self, *place, half: Vector, **more):
        super().__init__(*place, radius=float(np.linalg.norm(half)), **more)
        self.half = half

    def hit(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        """See ``Shape.hit``."""
        with np.errstate(divide="ignore"):
            inverse = 1 / np.where(d == 0, np.finfo(d.dtype).tiny * 1e3, d)
        middle, reach = -o * inverse, np.abs(inverse) * np.asarray(self.half, d.dtype)
        near, far = (middle - reach).max(axis=1), (middle + reach).min(axis=1)
        return np.where((near < far) & (near > 0), near, np.inf).astype(d.dtype)

    def normal(self, p: np.ndarray) -> np.ndarray:
        """See ``Shape.normal``."""
        ratio = p / np.asarray(self.half, p.dtype)
        face = np.abs(ratio).argmax(axis=1)
        rows = np.arange(len(p))
        n = np.zeros_like(p)
        n[rows, face] = np.sign(ratio[rows, face])
        return n


class Cylinder(Shape):
    """An upright cylinder (axis: local y) with flat caps, of radius ``size`` and height 2 ``half_height`` [u]."""

    def __init__(self, *place, size: float, half_height: float, **more):
        super().__init__(*place, radius=float(np.hypot(size, half_height)), **more)
        self.size, self.half_height = size, half_height

    def hit(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        """See ``Shape.hit``."""
        # The solid is where an infinite cylinder and a slab overlap: enter at the later of the two entries.
        a = np.maximum(d[:, 0] ** 2 + d[:, 2] ** 2, 1e-12)
        b = d[:, 0] * o[0] + d[:, 2] * o[2]
        root = b * b - a * (o[0] ** 2 + o[2] ** 2 - self.size**2)
        reach = np.sqrt(np.maximum(root, 0))
        dy = np.where(np.abs(d[:, 1]) < 1e-9, 1e-9, d[:, 1])
        middle, slab = -o[1] / dy, self.half_height / np.abs(dy)
        near = np.maximum((-b - reach) / a, middle - slab)
        far = np.minimum((-b + reach) / a, middle + slab)
        return np.where((root > 0) & (near < far) & (near > 0), near, np.inf).astype(d.dtype)

    def normal(self, p: np.ndarray) -> np.ndarray:
        """See ``Shape.normal``."""
        across = np.hypot(p[:, 0], p[:, 2])
        side = across / self.size > np.abs(p[:, 1]) / self.half_height
        n = np.zeros_like(p)
        n[:, [0, 2]] = np.where(side[:, None], p[:, [0, 2]] / np.maximum(across, 1e-6)[:, None], 0)
        n[:, 1] = np.where(side, 0, np.sign(p[:, 1]))
        return n


class Torus(Shape):
    """A torus around the local y axis: a tube of radius ``tube`` around a circle of radius ``ring`` [u]."""

    def __init__(self, *place, ring: float, tube: float, **more):
        super().__init__(*place, radius=ring + tube, **more)
        self.ring, self.tube = ring, tube

    def _distance(self, p: np.ndarray) -> np.ndarray:
        """Return the signed distance to the surface [u], shape [N], of local positions [N, 3]."""
        return np.hypot(np.hypot(p[:, 0], p[:, 2]) - self.ring, p[:, 1]) - self.tube

    def hit(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        """See ``Shape.hit``."""
        # Steps as long as the distance to the surface never jump through it: simpler than a quartic, and as exact.
        tolerance = 1e-5 if d.dtype == np.float32 else 1e-9
        b = matmul(d, o)
        half = np.sqrt(np.maximum(b * b - (matmul(o, o) - self.radius**2), 0))
        out = np.full(len(d), np.inf, d.dtype)
        live = np.flatnonzero(half > 0)
        t, end = (-b - half)[live], (-b + half)[live]
        for _ in range(96):
            gap = self._distance(o + t[:, None] * d[live])
            done = gap < tolerance
            out[live[done]] = t[done] + gap[done]
            t = t + gap
            keep = ~done & (t < end)
            live, t, end = live[keep], t[keep], end[keep]
            if not len(live):
                break
        return np.where(out > 0, out, np.inf).astype(d.dtype)

    def normal(self, p: np.ndarray) -> np.ndarray:
        """See ``Shape.normal``."""
        n = p.copy()
        n[:, [0, 2]] *= (1 - self.ring / np.maximum(np.hypot(p[:, 0], p[:, 2]), 1e-6))[:, None]
        return n / np.linalg.norm(n, axis=1, keepdims=True)


@dataclass(frozen=True)
class Light:
    """A distant soft light, and ambient light of the surroundings."""

    direction: Vector = (-0.45, -0.75, -0.5)
    """Direction towards the light, any length."""
    sun: float = 0.62
    """Brightness of a surface that faces the light, above the ambient."""
    ambient: float = 0.6
    """Brightness where the light does not reach."""
    sharpness: float = 5.0
    """Steepness of a shadow's edge, per unit of clearance over distance."""


def cast(shapes: Sequence[Shape], origin: np.ndarray, dirs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return distances [N] [u] and shapes [N] that rays ``dirs`` [N, 3] from one point hit first; inf and -1 for none."""
    t = np.full(len(dirs), np.inf, dirs.dtype)
    index = np.full(len(dirs), -1, np.int16)
    for i, shape in enumerate(shapes):
        rotation = shape.rotation.astype(dirs.dtype)
        away = origin - np.asarray(shape.center)
        rows = slice(None)
        if np.isfinite(shape.radius):
            along = matmul(dirs, away.astype(dirs.dtype))
            rows = np.flatnonzero(along * along > float(matmul(away, away)) - 1.001 * shape.radius**2)
            if not len(rows):
                continue
        found = shape.hit(matmul(away, shape.rotation).astype(dirs.dtype), matmul(dirs[rows], rotation))
        closer = found < t[rows]
        t[rows] = np.where(closer, found, t[rows])
        index[rows] = np.where(closer, np.int16(i), index[rows])
    return t, index


def shade(shapes: Sequence[Shape], light: Light, x: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Return colours [N, 3] of points ``x`` [N, 3] on shapes ``index`` [N]: albedo, soft light, contact shade, soft shadows."""
    rgb, normals = np.zeros_like(x), np.zeros_like(x)
    for i, shape in enumerate(shapes):
        if len(rows := np.flatnonzero(index == i)):
            p = shape.local(x[rows])
            rgb[rows] = shape.texture(p)
            normals[rows] = matmul(shape.normal(p), shape.rotation.T.astype(x.dtype))
    to_light = np.asarray(light.direction, x.dtype)
    to_light = to_light / np.linalg.norm(to_light)
    lit, open_sky = np.ones(len(x), x.dtype), np.ones(len(x), x.dtype)
    for i, shape in enumerate(shapes):
        if not np.isfinite(shape.radius) or not shape.shading:
            continue
        # Each object casts the shadow of a sphere of its size: smooth everywhere, without a second ray.
        bulk = shape.shading * shape.radius
        rows = np.flatnonzero(index != i)
        away = np.asarray(shape.center, x.dtype) - x[rows]
        square = np.einsum("ij,ij->i", away, away)
        facing = np.maximum(np.einsum("ij,ij->i", away, normals[rows]), 0) / np.sqrt(square)
        open_sky[rows] *= 1 - 0.85 * facing * np.minimum(bulk**2 / square, 1)
        along = matmul(away, to_light)
        clearance = (np.sqrt(np.maximum(square - along * along, 0)) - bulk) / np.maximum(along, 1e-3)
        edge = np.clip(0.5 + light.sharpness * clearance, 0, 1)
        lit[rows] *= np.where(along > 0, edge * edge * (3 - 2 * edge), 1)
    return np.clip(rgb * (light.ambient * open_sky + light.sun * lit * np.maximum(matmul(normals, to_light), 0))[:, None], 0, 1)


def pixel_rays(K: np.ndarray, viewmat: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Return unit world directions [N, 3] through image positions ``xy`` [N, 2] [px]."""
    d = np.ones((len(xy), 3), xy.dtype)
    d[:, 0] = (xy[:, 0] - K[0, 2]) / K[0, 0]
    d[:, 1] = (xy[:, 1] - K[1, 2]) / K[1, 1]
    d /= np.sqrt(np.einsum("ij,ij->i", d, d))[:, None]
    return matmul(d, viewmat[:3, :3].astype(xy.dtype))


def render_rgba(
    shapes: Sequence[Shape], light: Light, K: np.ndarray, viewmat: np.ndarray, width: int, height: int, samples: int = 3
) -> np.ndarray:
    """Render colours over black and alpha, the fraction of ``samples`` x ``samples`` rays that hit, float32 [H, W, 4]."""
    origin = -matmul(viewmat[:3, :3].T, viewmat[:3, 3])
    sub = (np.arange(width * samples, dtype=np.float32) + 0.5) / samples
    out = np.empty((height, width, 4), np.float32)
    rows = max(1, BAND_RAYS // (width * samples**2))
    for top in range(0, height, rows):
        bottom = min(top + rows, height)
        ys = (np.arange(top * samples, bottom * samples, dtype=np.float32) + 0.5) / samples
        d = pixel_rays(K, viewmat, np.stack(np.meshgrid(sub, ys), axis=-1).reshape(-1, 2))
        t, index = cast(shapes, origin, d)
        x = origin.astype(np.float32) + np.where(np.isfinite(t), t, 0)[:, None] * d
        tiles = (bottom - top, samples, width, samples)
        out[top:bottom, :, :3] = shade(shapes, light, x, index).reshape(*tiles, 3).mean(axis=(1, 3))
        out[top:bottom, :, 3] = (index >= 0).reshape(tiles).mean(axis=(1, 3))
    return out


def render(
    shapes: Sequence[Shape], light: Light, K: np.ndarray, viewmat: np.ndarray, width: int, height: int, samples: int = 3
) -> np.ndarray:
    """Return the colours of `render_rgba`, over black: float32, shape [H, W, 3]."""
    return np.ascontiguousarray(render_rgba(shapes, light, K, viewmat, width, height, samples)[..., :3])
