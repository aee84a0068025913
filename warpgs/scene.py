"""Data types of the whole package: scenes, models and renders.

Conventions (docs/conventions.md): camera_from_world poses, OpenCV axes (+x right, +y down, +z forward), pixel centres at
+0.5, quaternions wxyz, log scales, logit opacities, colours in [0, 1]. Lengths are in scene units [u].
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from warpgs.field_docs import document_fields

if TYPE_CHECKING:
    import torch

    Array = np.ndarray | torch.Tensor


@document_fields
@dataclass(frozen=True)
class Camera:
    """One camera, or a batch of C cameras that share an image size and a camera model.

    Readers return cameras with numpy float64 arrays. The rasterizer also accepts torch tensors and computes their gradients.
    """

    viewmat: Array
    """camera_from_world, rigid, shape [4, 4] or [C, 4, 4]."""
    K: Array
    """Intrinsics [px] with zero skew, shape [3, 3] (shared by all cameras) or [C, 3, 3]."""
    width: int
    """Image width [px]."""
    height: int
    """Image height [px]."""
    model: str = "pinhole"
    """Name of the camera model: pinhole, orthographic, opencv, fisheye (docs/rasterizer.md), or one of your own."""
    distortion: Array | None = None
    """Coefficients, shape [P] (shared by all cameras) or [C, P]; None for models without coefficients. opencv has k1 k2 p1 p2
    k3 k4 k5 k6, fisheye k1 to k4; zeros mean an ideal lens. A tensor that requires gradients is an error."""

    @property
    def center(self) -> np.ndarray:
        """Camera centre in the world [u], shape [..., 3] (numpy cameras only)."""
        R, t = self.viewmat[..., :3, :3], self.viewmat[..., :3, 3]
        return np.asarray(-np.einsum("...ij,...i->...j", R, t))


DEPTH_KINDS = ("metric", "relative", "disparity")
"""Meanings of a given depth map: lengths; lengths up to a scale and a shift; inverse lengths up to a scale and a shift."""


@dataclass(frozen=True)
class GivenDepth:
    """Depth map of one view from another source than the photographs: a sensor, a laser scan or a network."""

    values: np.ndarray
    """z-depth or, for kind disparity, inverse z-depth; float32, shape [H, W]; 0 for missing values."""
    kind: str = "metric"
    """Meaning of the values, one of `DEPTH_KINDS`: metric in [u]; the others with an unknown scale and shift for each view."""
    confidence: np.ndarray | None = None
    """Confidence in each value, in [0, 1], float32, shape [H, W]; None for 1 everywhere."""


@document_fields
@dataclass(frozen=True)
class View:
    """An image with its camera."""

    name: str
    """Path of the image relative to the scene's image folder, POSIX style: the key of the view."""
    camera: Camera
    """Camera, at the size of ``image``."""
    image: np.ndarray
    """Colours in [0, 1], float32, shape [H, W, 3]."""
    mask: np.ndarray | None = None
    """True for pixels that are used, bool, shape [H, W]; None to use all."""
    score_mask: np.ndarray | None = None
    """True where a render is scored, bool, shape [H, W]; the fit does not use it. None to score by ``mask``."""
    alpha: np.ndarray | None = None
    """Opacity of the subject, which ``image`` shows over the background; [0, 1], float32, shape [H, W]. None if opaque."""
    alpha_estimated: bool = False
    """True if ``alpha`` was estimated from a black background: it then selects the pixels that start Gaussians and are scored.
    The loss does not use it, because dark parts of the object may count as background."""
    depth: GivenDepth | None = None
    """Given depth, for the start and the loss of a fit; None if there is none."""
    normals: np.ndarray | None = None
    """Given normals: unit vectors towards the camera, in camera axes (+x right, +y down, +z forward), float32, shape [H, W, 3];
    0 for missing values. None without normals."""


@dataclass(frozen=True)
class PointCloud:
    """Coloured 3D points."""

    points: np.ndarray
    """World positions [u], float64, shape [N, 3]."""
    colors: np.ndarray
    """Colours in [0, 1], float32, shape [N, 3]."""
    tracks: tuple[frozenset[str], ...] | None = None
    """Names of the views that saw each point, length N; None if the format does not store them."""

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.points)

    def seen_by(self, names: set[str], least: int = 1) -> PointCloud:
        """Return the points seen by at least ``least`` of the views; all points if the tracks are unknown."""
        if self.tracks is None:
            return self
        keep = np.array([len(names & t) >= least for t in self.tracks], dtype=bool)
        tracks = tuple(t for t, k in zip(self.tracks, keep) if k)
        return PointCloud(self.points[keep], self.colors[keep], tracks)


@dataclass(frozen=True)
class Normalization:
    """Similarity from file coordinates to scene coordinates: ``x_scene = scale * (x_file - offset)``."""

    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """Offset [file units], float64, shape [3]."""
    scale: float = 1.0
    """Scene units per file unit."""


@document_fields
@dataclass(frozen=True)
class Scene:
    """A scene: views, points and notes, in the conventions of docs/conventions.md."""

    path: str
    """Folder that was read."""
    format: str
    """Name of the dataset format: colmap, transforms, llff, dtu, middlebury, or that of your own reader."""
    views: tuple[View, ...]
    """All views, sorted by name."""
    points: PointCloud | None = None
    """Sparse points of the reconstruction; None if the format has none."""
    normalization: Normalization = field(default_factory=Normalization)
    """Similarity from file to scene coordinates."""
    notes: tuple[str, ...] = ()
    """Messages about choices made while reading (skipped images, undistortion, the chosen image folder)."""
    fingerprint: str = ""
    """SHA-256 over names, cameras, pixels, masks and given maps of the views, hexadecimal."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Background colour, as implied by the format (white for Blender's transparent images)."""
    pixels: str = ""
    """Source of the pixels: the image folder, and whether they are as stored or area-resampled. Scores against `images_8` and
    against `images` resampled by 8 cannot be compared."""

    @property
    def transparent(self) -> bool:
        """True if a view has an alpha channel, as photographs of a cut-out object do."""
        return any(v.alpha is not None for v in self.views)

    def view(self, name: str) -> View:
        """Return the view of that name.

        Raises:
            KeyError: No view has this name.
        """
        return self._by_name[name]

    @cached_property
    def _by_name(self) -> dict[str, View]:
        return {v.name: v for v in reversed(self.views)}  # the first of equal names


@dataclass(frozen=True)
class Mesh:
    """A surface of triangles, coloured at its vertices."""

    vertices: np.ndarray
    """World positions [u], float64, shape [V, 3]."""
    faces: np.ndarray
    """Vertices of each triangle, counter-clockwise seen from outside, int32, shape [F, 3]."""
    colors: np.ndarray
    """Colours in [0, 1] (sRGB), float32, shape [V, 3]."""


@dataclass(frozen=True)
class Prior:
    """Maps of one view that are computed before the fit; each is float32, shape [H, W], in [0, 1]."""

    disparity: np.ndarray
    """Relative inverse depth, 0 at the farthest and 1 at the nearest pixel of the view; 0 everywhere if depth is unknown."""
    confidence: np.ndarray
    """Probability of the likeliest class: F_seg of the paper (Multi-Modal Importance Assessment)."""
    boundary: np.ndarray
    """omega_boundary: 1 at label changes, falling with the distance to them."""
    foreground: np.ndarray
    """omega_foreground: probability of not being background. If the view has no semantics, this map and ``boundary`` are 0
    everywhere, and its semantic weight must be 0."""
    depth_source: str
    """Source of the disparity, a phrase for reports."""
    semantics_source: str
    """Source of the other three maps, a phrase for reports."""


@dataclass(frozen=True)
class ViewDepth:
    """Depth at the pixels of one view, where other views confirm it; it is estimated or given, not rendered."""

    depth: np.ndarray
    """z-depth [u], float32, shape [H, W]; 0 where not valid."""
    valid: np.ndarray
    """True where the depth passed every check, bool, shape [H, W]."""
    sensitivity: np.ndarray
    """|dz/dpx| [u/px]: change of the depth as the match slides along its epipolar line; float32, shape [H, W]; infinite where
    not valid."""
    notes: tuple[str, ...] = ()
    """Messages for the user: pairs left out, files missing, nothing found."""
    searched: bool = True
    """False if the depth of the view was not estimated, because enough other views have depth."""
    given: np.ndarray | None = None
    """Given z-depth [u] that no other view contradicts, float32, shape [H, W], 0 for missing values; None if none was given."""

    @property
    def coverage(self) -> float:
        """Fraction of the pixels that are valid, in [0, 1]."""
        return float(self.valid.mean())


@document_fields
@dataclass(frozen=True)
class Gaussians:
    """A set of N Gaussians with the parameters that a fit optimises; the kernels apply exp, sigmoid and normalisation."""

    means: torch.Tensor
    """World positions [u], shape [N, 3]."""
    quats: torch.Tensor
    """Rotations wxyz, any length from 1e-15 to 1e15, shape [N, 4]."""
    log_scales: torch.Tensor
    """Natural logarithm of the axis lengths [u], shape [N, 3]."""
    logit_opacities: torch.Tensor
    """Inverse sigmoid of the opacity, shape [N]."""
    sh: torch.Tensor
    """Spherical-harmonics coefficients, shape [N, K, 3] with K = (degree + 1)^2, K in {1, 4, 9, 16, 25}."""

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int:
        """Highest spherical-harmonics degree stored."""
        return int(round(self.sh.shape[1] ** 0.5)) - 1

    def tensors(self) -> dict[str, torch.Tensor]:
        """Return the five tensors by field name, in a fixed order."""
        return {name: getattr(self, name) for name in ("means", "quats", "log_scales", "logit_opacities", "sh")}

    def to(self, device: str | torch.device) -> Gaussians:
        """Return the same N Gaussians on a device. Differentiable, as `torch.Tensor.to` is."""
        return Gaussians(**{name: t.to(device) for name, t in self.tensors().items()})


@document_fields
@dataclass(frozen=True)
class ActivatedGaussians:
    """A set of N Gaussians given by scales and opacities, for `rasterize`; fits and files use `Gaussians`.

    Opacity 1 and scale 0 are allowed and have finite gradients: the rule clamps alpha, and the pixel filter keeps a flat
    Gaussian visible edge-on.
    """

    means: torch.Tensor
    """World positions [u], shape [N, 3]."""
    quats: torch.Tensor
    """Rotations wxyz, any length from 1e-15 to 1e15, shape [N, 4]."""
    scales: torch.Tensor
    """Axis lengths [u], at least 0, shape [N, 3]."""
    opacities: torch.Tensor
    """Opacities in [0, 1], shape [N]."""
    sh: torch.Tensor | None = None
    """Spherical-harmonics coefficients, shape [N, K, 3] as in `Gaussians`; None with ``RasterizeOptions.colors``."""

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int:
        """Highest spherical-harmonics degree given; 0 without ``sh``."""
        return 0 if self.sh is None else int(round(self.sh.shape[1] ** 0.5)) - 1

    def tensors(self) -> dict[str, torch.Tensor]:
        """Return the five tensors by field name, in the order of `Gaussians`; ``sh`` is zeros [N, 1, 3] if it is None."""
        sh = self.means.new_zeros(len(self), 1, 3) if self.sh is None else self.sh
        return {"means": self.means, "quats": self.quats, "scales": self.scales, "opacities": self.opacities, "sh": sh}

    def stored(self) -> Gaussians:
        """Return the same N Gaussians by log scales and logits: scale 0 becomes -inf, opacity 1 inf, which no file stores."""
        means, quats, scales, opacities, sh = self.tensors().values()
        return Gaussians(means, quats, scales.log(), opacities.logit(), sh)


@document_fields
@dataclass(frozen=True)
class CovarianceGaussians:
    """A set of N Gaussians given by covariances and opacities, for `rasterize`; fits and files use `Gaussians`."""

    means: torch.Tensor
    """World positions [u], shape [N, 3]."""
    covars: torch.Tensor
    """Covariances [u^2], positive semi-definite, shape [N, 3, 3]. Only the symmetric part of a matrix is used. Eigenvalues
    between 0 and -1e-5 times the largest variance count as 0; a Gaussian with a lower or non-finite eigenvalue is culled. A
    covariance of zeros renders as a point with the width of the pixel filter."""
    opacities: torch.Tensor
    """Opacities in [0, 1], shape [N]."""
    sh: torch.Tensor | None = None
    """Spherical-harmonics coefficients, shape [N, K, 3] as in `Gaussians`; None with ``RasterizeOptions.colors``."""

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int:
        """Highest spherical-harmonics degree given; 0 without ``sh``."""
        return 0 if self.sh is None else int(round(self.sh.shape[1] ** 0.5)) - 1

    def tensors(self) -> dict[str, torch.Tensor]:
        """Return the four tensors by field name, in a fixed order; ``sh`` is zeros [N, 1, 3] if it is None."""
        sh = self.means.new_zeros(len(self), 1, 3) if self.sh is None else self.sh
        return {"means": self.means, "covars": self.covars, "opacities": self.opacities, "sh": sh}


RasterizedGaussians = Gaussians | ActivatedGaussians | CovarianceGaussians
"""Types of Gaussians that `rasterize` accepts."""


@document_fields
@dataclass(frozen=True)
class Render:
    """Result of the rasterizer for one camera (no leading axis) or for a batch of C cameras (leading axis C).

    With ``RasterizeOptions.pixels``, images have one axis P instead of H and W.
    """

    rgb: torch.Tensor
    """Colour over the background, shape [..., H, W, 3]; not clamped. It has D channels if ``RasterizeOptions.colors`` has D."""
    alpha: torch.Tensor
    """Accumulated opacity in [0, 1], shape [..., H, W]."""
    depth: torch.Tensor
    """Expected z-depth [u] (for a fisheye the distance): the mean weighted by blending weights; 0 where nothing is blended.
    Shape [..., H, W]."""
    projected: torch.Tensor
    """Projected Gaussians, laid out as in kernels/project_inputs.py, shape [C, N, 12]; ``retain_grad()`` keeps gradients."""
    tile_counts: torch.Tensor
    """Number of tiles that a Gaussian touches, int32, shape [C, N]; 0 where it is culled."""
    weight_sums: torch.Tensor | None = None
    """Sum over pixels of a Gaussian's blending weight, shape [C, N]; only with ``RasterizeOptions.contributions``. It has no
    gradient: a backward pass through it is an error."""
    weight_maxima: torch.Tensor | None = None
    """Largest blending weight of a Gaussian over the pixels, shape [C, N]; only with ``RasterizeOptions.contributions``. It has
    no gradient: a backward pass through it is an error."""
    overflow: torch.Tensor | None = None
    """1 if the (Gaussian, tile) pairs exceeded ``RasterizeOptions.capacity`` (the images are unusable), else 0; int32, [1]."""
    median_depth: torch.Tensor | None = None
    """Depth [u] (along z; for a fisheye the distance) of the Gaussian at which transmittance falls to one half, shape [..., H,
    W]; 0 where alpha is below 1/2. Only if requested. It has no gradient: a backward pass through it is an error."""
    error_bound: torch.Tensor | None = None
    """Upper bound of the error of ``rgb`` against rule `exact`, over all channels, shape [..., H, W]; see
    ``RasterizeOptions.error_bound``. Only if requested. It has no gradient: a backward pass through it is an error."""
    features: torch.Tensor | None = None
    """Channels of ``RasterizeOptions.features`` over their background, shape [..., H, W, D]; only with features."""
    heaviest_ids: torch.Tensor | None = None
    """Indices of the k Gaussians of largest blending weight in each pixel, heaviest first, at equal weights the nearer
    first; -1 if there are fewer. Int32, shape [..., H, W, k]; only with ``RasterizeOptions.heaviest``."""
    heaviest_weights: torch.Tensor | None = None
    """Blending weights of ``heaviest_ids``, 0 for missing ones, shape [..., H, W, k]. They have no gradient: a backward pass
    through them is an error."""
    blend_counts: torch.Tensor | None = None
    """Number of Gaussians blended in each pixel, int32, shape [..., H, W]; only with ``RasterizeOptions.heaviest``."""
    absgrad: bool = False
    """True where ``RasterizeOptions.absgrad`` was set."""

    @cached_property
    def means2d(self) -> torch.Tensor:
        """Projected means [px], shape [C, N, 2]; read them before the backward pass.

        The backward pass sets ``means2d.grad``, shape [C, N, 2]. With ``RasterizeOptions.absgrad`` it also sets
        ``means2d.absgrad``, the sums over pixels of the gradients' magnitudes. The means are a copy for density strategies: a
        backward pass through them is an error.

        Raises:
            UsageError: The backward pass of the render has already run.
        """
        from warpgs.means2d import projected_means

        return projected_means(self.projected, self.absgrad)

    @property
    def visible(self) -> torch.Tensor:
        """Mask [C, N], True where a Gaussian touches at least one tile."""
        return self.tile_counts > 0
