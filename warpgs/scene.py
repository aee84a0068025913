"""The types that flow through the program: what a scene is, what a model is, what a rendering is.

Conventions (docs/conventions.md): camera_from_world poses, OpenCV axes (+x right, +y down, +z forward), pixel centres at
+0.5, quaternions wxyz, log scales, logit opacities, colours in [0, 1]. Lengths are in scene units [u].
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import torch

    Array = np.ndarray | torch.Tensor


@dataclass(frozen=True)
class Camera:
    """One pinhole camera, or a batch of C cameras that share an image size.

    Readers make numpy float64 cameras; the rasterizer also takes torch tensors, and gradients flow into them.
    """

    viewmat: Array
    """camera_from_world, rigid, shape [4, 4] or [C, 4, 4]."""
    K: Array
    """Intrinsics [px] with zero skew, shape [3, 3] or [C, 3, 3]."""
    width: int
    """Image width [px]."""
    height: int
    """Image height [px]."""

    @property
    def center(self) -> np.ndarray:
        """Camera centre in the world [u], shape [..., 3] (numpy cameras only)."""
        R, t = self.viewmat[..., :3, :3], self.viewmat[..., :3, 3]
        return -np.einsum("...ij,...i->...j", R, t)


@dataclass(frozen=True)
class View:
    """A photograph with its camera."""

    name: str
    """Path of the image relative to the scene's image folder, POSIX style: the key of the view."""
    camera: Camera
    """Its camera, at the size of ``image``."""
    image: np.ndarray
    """Colours in [0, 1], float32, shape [H, W, 3]."""
    mask: np.ndarray | None = None
    """True where the pixel counts, bool, shape [H, W]; None where every pixel counts."""
    score_mask: np.ndarray | None = None
    """True where a rendering is scored, bool, shape [H, W], and no say in the fit; None where ``mask`` decides both."""


@dataclass(frozen=True)
class PointCloud:
    """Coloured 3D points."""

    points: np.ndarray
    """World positions [u], float64, shape [N, 3]."""
    colors: np.ndarray
    """Colours in [0, 1], float32, shape [N, 3]."""
    tracks: tuple[frozenset[str], ...] | None = None
    """For each point the names of the views that saw it, length N; None where the format does not say."""

    def __len__(self) -> int:
        """Number of points."""
        return len(self.points)

    def seen_by(self, names: set[str]) -> PointCloud:
        """The points whose tracks touch at least one of the named views; all points where tracks are unknown."""
        if self.tracks is None:
            return self
        keep = np.array([not names.isdisjoint(t) for t in self.tracks], dtype=bool)
        tracks = tuple(t for t, k in zip(self.tracks, keep) if k)
        return PointCloud(self.points[keep], self.colors[keep], tracks)


@dataclass(frozen=True)
class Normalization:
    """The similarity that took file coordinates to scene coordinates: ``x_scene = scale * (x_file - offset)``."""

    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """Offset [file units], float64, shape [3]."""
    scale: float = 1.0
    """Scene units per file unit."""


@dataclass(frozen=True)
class Scene:
    """Everything read from a scene folder, converted to the house conventions."""

    path: str
    """The folder that was read."""
    format: str
    """Name of the dataset format: colmap, transforms, llff, dtu or middlebury."""
    views: tuple[View, ...]
    """All views, sorted by name."""
    points: PointCloud | None = None
    """Sparse points of the reconstruction; None where the format has none."""
    normalization: Normalization = field(default_factory=Normalization)
    """How to get back to the coordinates of the files."""
    notes: tuple[str, ...] = ()
    """Choices made while reading that a user must know of (skipped images, undistortion, the image folder taken)."""
    fingerprint: str = ""
    """SHA-256 over names, cameras and pixels, hexadecimal: the same data gives the same fingerprint."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Colour behind the scene that the format implies (white for Blender's transparent images)."""
    pixels: str = ""
    """Where the pixels come from: the image folder, and whether they are as stored or area-resampled. Scores against
    `images_8` and against `images` resampled by 8 do not compare."""

    def view(self, name: str) -> View:
        """The view of that name; KeyError where there is none."""
        for v in self.views:
            if v.name == name:
                return v
        raise KeyError(name)


@dataclass(frozen=True)
class Prior:
    """What is believed of one view's pixels before anything is fitted; every map is float32, shape [H, W], in [0, 1]."""

    disparity: np.ndarray
    """Relative inverse depth, 0 at the farthest and 1 at the nearest pixel of the view; 0 everywhere where nothing is known."""
    confidence: np.ndarray
    """Probability of the likeliest class: F_seg of the paper (Multi-Modal Importance Assessment)."""
    boundary: np.ndarray
    """omega_boundary: 1 at label changes, falling with the distance to them."""
    foreground: np.ndarray
    """omega_foreground: probability of not being background. 0 everywhere, as then is ``boundary``, where semantics say nothing
    of the view: its semantic weight must then be 0."""
    depth_source: str
    """Where the disparity comes from, a phrase for reports."""
    semantics_source: str
    """Where the other three come from, a phrase for reports."""


@dataclass(frozen=True)
class ViewDepth:
    """Depth that other views confirm at the pixels of one view: evidence, not a rendering."""

    depth: np.ndarray
    """z-depth [u], float32, shape [H, W]; 0 where not valid."""
    valid: np.ndarray
    """True where the depth passed every check, bool, shape [H, W]."""
    sensitivity: np.ndarray
    """|dz/dpx| [u/px]: change of the depth as the match slides along its epipolar line; float32, shape [H, W]; infinite where
    not valid."""
    notes: tuple[str, ...] = ()
    """What a user must know: pairs left out, files missing, nothing found."""

    @property
    def coverage(self) -> float:
        """Share of the pixels that are valid, in [0, 1]."""
        return float(self.valid.mean())


@dataclass(frozen=True)
class Gaussians:
    """A set of N Gaussians as stored and optimised; the kernels apply exp, sigmoid and normalisation."""

    means: torch.Tensor
    """World positions [u], shape [N, 3]."""
    quats: torch.Tensor
    """Rotations wxyz, any length from 1e-15 to 1e15, shape [N, 4]."""
    log_scales: torch.Tensor
    """Natural logarithm of the axis lengths [u], shape [N, 3]."""
    logit_opacities: torch.Tensor
    """Inverse sigmoid of the opacity, shape [N]."""
    sh: torch.Tensor
    """Spherical-harmonics coefficients, shape [N, K, 3] with K = (degree + 1)^2, K in {1, 4, 9, 16}."""

    def __len__(self) -> int:
        """Number of Gaussians."""
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int:
        """Highest degree stored."""
        return int(round(self.sh.shape[1] ** 0.5)) - 1

    def tensors(self) -> dict[str, torch.Tensor]:
        """The five tensors by field name, in a fixed order."""
        return {name: getattr(self, name) for name in ("means", "quats", "log_scales", "logit_opacities", "sh")}


@dataclass(frozen=True)
class Render:
    """What the rasterizer returns for one camera (no leading axis) or for a batch of C cameras (leading axis C)."""

    rgb: torch.Tensor
    """Colour over the background, shape [..., H, W, 3]; not clamped."""
    alpha: torch.Tensor
    """Accumulated opacity in [0, 1], shape [..., H, W]."""
    depth: torch.Tensor
    """Expected z-depth [u], divided by alpha; 0 where alpha is 0. Shape [..., H, W]."""
    projected: torch.Tensor
    """Projected Gaussians in the record layout of kernels/project.py, shape [C, N, 12]; retains gradients on request."""
    tile_counts: torch.Tensor
    """Number of tiles that a Gaussian touches, int32, shape [C, N]; 0 where it is culled."""
    weight_sums: torch.Tensor | None = None
    """Sum over pixels of a Gaussian's blending weight, shape [C, N]; only where contributions were asked for."""
    weight_maxima: torch.Tensor | None = None
    """Largest blending weight of a Gaussian over the pixels, shape [C, N]; only where contributions were asked for."""
    overflow: torch.Tensor | None = None
    """1 where the instances did not fit into the capacity asked for, and the pictures must not be used; else 0. Int32,
    shape [1]; only where a capacity was given."""

    @property
    def visible(self) -> torch.Tensor:
        """True where a Gaussian touches at least one tile, shape [C, N]."""
        return self.tile_counts > 0
