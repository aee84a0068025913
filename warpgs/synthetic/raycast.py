"""A small ray caster in numpy: shapes with smooth solid textures under one soft light, without OpenGL and without meshes.

With it the demo scene needs no download and no graphics driver. Every shape computes, in its own frame, the first hit of a ray
and the normal there, and has a bounding sphere. So an image, the exact depth of a pixel and the visibility of a point all come
from the same intersection code. Shading is diffuse: a surface point has one colour from all directions.

Axes as in an OpenCV camera: +x right, +y down, +z away from the viewer. Lengths in scene units [u].
"""

from __future__ import annotations

import abc
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from warpgs.geometry import matmul

BAND_RAYS = 40_000
"""Number of rays cast at once: the working set of a band stays in the second-level cache."""


@dataclass(frozen=True)
class Texture:
    """A solid texture: a smoothed checker between two colours, plus plane waves that tint it."""

    low: tuple[float, float, float]
    """Colour of one half of the checker, in [0, 1]."""
    high: tuple[float, float, float]
    """Colour of the other half, in [0, 1]."""
    checker: tuple[float, float, float]
    """Angular frequencies of the checker along the local axes [rad/u]; 0 leaves an axis out."""
    waves: np.ndarray
    """Angular wave vectors [rad/u], shape [W, 3]."""
    tints: np.ndarray
    """RGB amplitude of every wave, shape [W, 3]."""
    phases: np.ndarray
    """Phases [rad]: the three of the checker, then one for every wave, shape [3 + W]."""
    softness: float = 2.8
    """Gain before the tanh that rounds the checker's edges: a larger gain makes crisper edges."""

    def __call__(self, p: np.ndarray) -> np.ndarray:
        """Return the albedo [N, 3] in [0, 1] at local positions [N, 3] [u]."""
        dt = p.dtype
        product = np.ones(len(p), dt)
        for axis, frequency in enumerate(self.checker):
            if frequency:
                product *= np.sin(p[:, axis] * dt.type(frequency) + dt.type(self.phases[axis]))
        mix = (0.5 + 0.5 * np.tanh(dt.type(self.softness) * product))[:, None]
        low, high = np.asarray(self.low, dt), np.asarray(self.high, dt)
        ripple = matmul(np.sin(matmul(p, self.waves.T.astype(dt)) + self.phases[3:].astype(dt)), self.tints.astype(dt))
        return np.clip(low + mix * (high - low) + ripple, 0.0, 1.0)


@dataclass(frozen=True)
class Shape(abc.ABC):
    """A textured shape at a place; subclasses give its geometry in the local frame ``x_local = R^T (x - center)``."""

    center: tuple[float, float, float]
    """Origin of the local frame in the world [u]."""
    texture: Texture
    """Albedo as a function of local position."""
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    """Rotation world_from_local, shape [3, 3]."""
    shading: float = 0.8
    """Radius of the sphere that casts the shadow of the shape, divided by the radius of its bounding sphere; 0 for thin shapes,
    which cast no shadow, because a sphere's shadow would be too large."""

    @property
    def radius(self) -> float:
        """Radius of the bounding sphere around ``center`` [u]; infinite without one."""
        return np.inf

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


@dataclass(frozen=True)
class Sphere(Shape):
    """A sphere around ``center``."""

    size: float = 1.0
    """Radius of the shape [u]."""

    @property
    def radius(self) -> float:
        """See ``Shape.radius``."""
        return self.size

    def hit(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        """See ``Shape.hit``."""
        b = matmul(d, o)
        root = b * b - (matmul(o, o) - self.size**2)
        t = -b - np.sqrt(np.maximum(root, 0))
        return np.where((root > 0) & (t > 0), t, np.inf).astype(d.dtype)

    def normal(self, p: np.ndarray) -> np.ndarray:
        """See ``Shape.normal``."""
        return p / np.linalg.norm(p, axis=1, keepdims=True)


@dataclass(frozen=True)
class Box(Shape):
    """A box around ``center``, its edges along the local axes."""

    half: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Half edge lengths [u]."""

    @property
    def radius(self) -> float:
        """See ``Shape.radius``."""
        return float(np.linalg.norm(self.half))

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


@dataclass(frozen=True)
class Cylinder(Shape):
    """An upright cylinder (axis: local y) with flat caps."""

    size: float = 1.0
    """Radius of the shape [u]."""
    half_height: float = 1.0
    """Half the height of the shape [u]."""

    @property
    def radius(self) -> float:
        """See ``Shape.radius``."""
        return float(np.hypot(self.size, self.half_height))

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
        n[:, 0] = np.where(side, p[:, 0] / np.maximum(across, 1e-6), 0)
        n[:, 1] = np.where(side, 0, np.sign(p[:, 1]))
        n[:, 2] = np.where(side, p[:, 2] / np.maximum(across, 1e-6), 0)
        return n


@dataclass(frozen=True)
class Torus(Shape):
    """A torus around the local y axis."""

    ring: float = 1.0
    """Radius of the circle in the middle of the tube [u]."""
    tube: float = 0.3
    """Radius of the tube [u]."""

    @property
    def radius(self) -> float:
        """See ``Shape.radius``."""
        return self.ring + self.tube

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
        across = np.maximum(np.hypot(p[:, 0], p[:, 2]), 1e-6)
        n = p.copy()
        n[:, [0, 2]] *= (1 - self.ring / across)[:, None]
        return n / np.linalg.norm(n, axis=1, keepdims=True)


@dataclass(frozen=True)
class Light:
    """A distant soft light, and ambient light of the surroundings."""

    direction: tuple[float, float, float] = (-0.45, -0.75, -0.5)
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
        rows = np.flatnonzero(index == i)
        if len(rows):
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
    brightness = light.ambient * open_sky + light.sun * lit * np.maximum(matmul(normals, to_light), 0)
    return np.clip(rgb * brightness[:, None], 0, 1)


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
        xy = np.stack(np.meshgrid(sub, ys), axis=-1).reshape(-1, 2)
        d = pixel_rays(K, viewmat, xy)
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
