"""Scenes, cameras and Gaussians: what the readers make and every other room takes, with the checks of every field."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sized
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np

from warpgs.constants import K_TOLERANCE, POSE_TOLERANCE
from warpgs.errors import DataError, document_fields

if TYPE_CHECKING:
    import torch

    Array = np.ndarray | torch.Tensor

Tensors = Mapping[str, "torch.Tensor"]
"""Tensors by name."""
C0 = 0.28209479177387814
"""Harmonic of degree 0, 1/2 sqrt(1/pi): a colour is 1/2 + C0 times its coefficient."""


def base_colors(sh: np.ndarray | torch.Tensor) -> np.ndarray | torch.Tensor:
    """Return the unclipped colours [N, 3] given by the degree-0 terms of coefficients [N, K, 3]."""
    return 0.5 + C0 * sh[:, 0]


def base_coefficients(colors: np.ndarray | torch.Tensor) -> np.ndarray | torch.Tensor:
    """Return the degree-0 coefficients that give colours [..., 3], in the same shape."""
    return (colors - 0.5) / C0


# Data types of the whole package: scenes, models and renders.
#
# Conventions (docs/conventions.md): camera_from_world poses, OpenCV axes (+x right, +y down, +z forward), pixel centres
# at +0.5, quaternions wxyz, log scales, logit opacities, colours in [0, 1]. Lengths are in scene units [u].


class _Record:
    """A dataclass with short text."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    def __repr__(self) -> str:
        """Return the shapes of arrays, the numbers of entries, and no field that has its default."""
        shown = []
        for entry in fields(self):
            value = getattr(self, entry.name)
            if not entry.repr or value is None or value is entry.default:
                continue
            shape = getattr(value, "shape", None)
            text = f"[{len(value)}]" if isinstance(value, (tuple, list)) else repr(value)[:80]
            shown.append(f"{entry.name}={text if shape is None else list(shape)}")
        return f"{type(self).__name__}({', '.join(shown)})"


@document_fields
@dataclass(frozen=True, repr=False)
class Camera(_Record):
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
@dataclass(frozen=True, repr=False)
class View(_Record):
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
    The loss uses it only away from the object, because dark parts of the object may count as background."""
    depth: GivenDepth | None = None
    """Given depth, for the start and the loss of a fit; None if there is none."""
    normals: np.ndarray | None = None
    """Given normals: unit vectors towards the camera, in camera axes (+x right, +y down, +z forward), float32, shape [H, W, 3];
    0 for missing values. None without normals."""


@dataclass(frozen=True, repr=False)
class PointCloud(_Record):
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
        return PointCloud(self.points[keep], self.colors[keep], tuple(t for t, k in zip(self.tracks, keep) if k))


ORIGIN = "warpgs_origin"
"""Name of the point [file units] that positions in a file are relative to (`Normalization.origin`), in comments and JSON."""
MAX_STEP = 1e-5
"""Largest step of float32 coordinates [u] in files without an origin: about a hundredth of a pixel at the cameras' distance."""


@dataclass(frozen=True)
class Normalization:
    """Similarity from file coordinates to scene coordinates: ``x_scene = scale * rotation @ (x_file - offset)``."""

    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """Offset [file units], float64, shape [3]."""
    scale: float = 1.0
    """Scene units per file unit."""
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    """Rotation from file axes to scene axes, float64, shape [3, 3]; the identity unless `warpgs level` turned the files."""
    up: np.ndarray | None = None
    """Upward direction in scene axes, length 1, float64, shape [3]; None unless `warpgs level` has set it."""
    unit: str = "units"
    """Name of the file unit: m if `warpgs level` has set the scale."""
    place: np.ndarray | None = None
    """Latitude, longitude [deg] and height [m] of 0 in files with x east, y north, z up, shape [3]; None if unknown."""

    @property
    def turned(self) -> bool:
        """Return whether file axes differ from scene axes."""
        return not np.array_equal(self.rotation, np.eye(3))

    @property
    def origin(self) -> np.ndarray:
        """Return the point [file units], shape [3], about which files are written: 0 unless float32 is too coarse.

        Map coordinates (UTM, ECEF) have steps of up to 0.5 m in float32. The point is in whole file units, or in decimal parts
        of them if the scene is smaller.
        """
        offset = np.asarray(self.offset, np.float64)
        with np.errstate(over="ignore"):
            step = float(np.spacing(np.abs(offset).max().astype(np.float32)))
        if not step * self.scale > MAX_STEP:
            return np.zeros(3)
        return np.asarray(np.round(offset, max(0, math.ceil(math.log10(self.scale)))) + 0.0)

    @property
    def local(self) -> Normalization:
        """Return the similarity to scene units from file units about the `origin`."""
        return replace(self, offset=np.asarray(self.offset, np.float64) - self.origin)


def checked_origin(values: object, where: str) -> np.ndarray:
    """Return the origin [3] that a file of ours states, float64; DataError if it is not three numbers."""
    try:
        origin = np.array(values, np.float64).reshape(3)
    except (TypeError, ValueError, OverflowError):
        origin = np.full(3, np.nan)
    if not np.isfinite(origin).all():
        raise DataError(f"{where}: {ORIGIN} must be three numbers, not {str(values)[:80]}; export the file again")
    return origin


@document_fields
@dataclass(frozen=True, repr=False)
class Scene(_Record):
    """A scene: views, points and notes, in the conventions of docs/conventions.md."""

    path: str
    """Folder that was read."""
    format: str
    """Name of the dataset format: colmap, transforms, llff, dtu, middlebury, metashape, realityscan, or that of your own."""
    views: tuple[View, ...]
    """All views, sorted by name."""
    points: PointCloud | None = None
    """Sparse points of the reconstruction; None if the format has none."""
    normalization: Normalization = field(default_factory=Normalization, repr=False)
    """Similarity from file to scene coordinates."""
    notes: tuple[str, ...] = field(default=(), repr=False)
    """Messages about choices made while reading (skipped images, undistortion, the chosen image folder)."""
    fingerprint: str = field(default="", repr=False)
    """SHA-256 over names, cameras, pixels, masks and given maps of the views, hexadecimal."""
    background: tuple[float, float, float] = field(default=(0.0, 0.0, 0.0), repr=False)
    """Background colour, as implied by the format (white for Blender's transparent images)."""
    pixels: str = field(default="", repr=False)
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


Box = tuple[np.ndarray, np.ndarray, np.ndarray]
"""A box: middle [3] and full sides [3] [u], and a rotation [3, 3] whose columns are the directions of the sides."""


@dataclass(frozen=True)
class Mesh:
    """A surface of triangles, coloured at its vertices, and by a texture if it has one."""

    vertices: np.ndarray
    """World positions [u], float64, shape [V, 3]."""
    faces: np.ndarray
    """Vertices of each triangle, counter-clockwise seen from outside, int32, shape [F, 3]."""
    colors: np.ndarray
    """Colours in [0, 1] (sRGB), float32, shape [V, 3]."""
    texture: np.ndarray | None = None
    """Image of the colours, 8-bit sRGB, shape [T, T, 3]; None for a mesh that has only colours at its vertices."""
    uv: np.ndarray | None = None
    """Place of each triangle's corners in the texture, from its upper left corner, in [0, 1], float32, shape [F, 3, 2]."""


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


class _GaussianSet(_Record):
    """What sets of Gaussians have in common, whatever their parameters."""

    means: torch.Tensor
    sh: torch.Tensor | None

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int:
        """Highest spherical-harmonics degree; 0 without ``sh``."""
        return 0 if self.sh is None else int(round(self.sh.shape[1] ** 0.5)) - 1

    def tensors(self) -> dict[str, torch.Tensor]:
        """Return the tensors by field name, in their order; ``sh`` is zeros [N, 1, 3] if it is None."""
        sh = self.means.new_zeros(len(self), 1, 3) if self.sh is None else self.sh
        return {name: getattr(self, name) for name in self.__dataclass_fields__} | {"sh": sh}


@document_fields
@dataclass(frozen=True, repr=False)
class Gaussians(_GaussianSet):
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

    def to(self, device: str | torch.device) -> Gaussians:
        """Return the same N Gaussians on a device. Differentiable, as `torch.Tensor.to` is."""
        return Gaussians(**{name: t.to(device) for name, t in self.tensors().items()})


@document_fields
@dataclass(frozen=True, repr=False)
class ActivatedGaussians(_GaussianSet):
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

    def stored(self) -> Gaussians:
        """Return the same N Gaussians by log scales and logits: scale 0 becomes -inf, opacity 1 inf, which no file stores."""
        means, quats, scales, opacities, sh = self.tensors().values()
        return Gaussians(means, quats, scales.log(), opacities.logit(), sh)


@document_fields
@dataclass(frozen=True, repr=False)
class CovarianceGaussians(_GaussianSet):
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


RasterizedGaussians = Gaussians | ActivatedGaussians | CovarianceGaussians
"""Types of Gaussians that `rasterize` accepts."""


@document_fields
@dataclass(frozen=True, repr=False)
class Render(_Record):
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
    """Projected Gaussians, laid out as in kernels/ellipse.py, shape [C, N, 12]; ``retain_grad()`` keeps gradients."""
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
    ``RasterizeOptions.error_bound``, and ``max_error``. Only if requested. It has no gradient: a backward pass through it is
    an error."""
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

        return projected_means([self.projected], self.absgrad)

    @property
    def visible(self) -> torch.Tensor:
        """Mask [C, N], True where a Gaussian touches at least one tile."""
        return self.tile_counts > 0


# Checks of scenes made in Python or by a reader: every field of views, cameras, maps and points, once, before they are
# used.
#
# A correct scene is returned as the same object. Tensors, other float types and strides of images, maps and points are
# converted to what the fields of `warpgs.scene` ask for. Anything else is a `DataError` that names the view, the field
# and the fix.

Record = TypeVar("Record", Camera, GivenDepth, View, PointCloud, Normalization, Scene)
SLACK = 1e-3
"""Accepted distance of a value from its range, a quarter of an 8-bit level: resampling and rounding may overshoot."""
MOST = float(np.finfo(np.float32).max)
"""Largest depth, and largest scale."""
COEFFICIENTS = {"pinhole": 0, "orthographic": 0, "opencv": 8, "fisheye": 4}
"""Number of coefficients of distortion by camera model; a model of the user's own is checked when it is rendered."""
MIN_FOCAL = 0.01
"""Smallest focal length of a pinhole in image sides: 179 degrees. Smaller ones are usually not in pixels."""
INTRINSICS = "give [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels"


def checked_scene(scene: Scene, where: str = "") -> Scene:
    """Return a scene whose fields are all valid."""
    of = f"{where}scene."
    for name in ("path", "format", "fingerprint", "pixels"):
        _check(of + name, getattr(scene, name), str, "give a str, '' if unknown")
    for name in ("views", "notes"):
        _check(of + name, getattr(scene, name), (tuple, list), f"give a tuple, ({name[:-1]}, ...)")
    for i, note in enumerate(scene.notes):
        _check(f"{of}notes[{i}]", note, str, "give str(note)")
    views, points, background, n = checked_views(scene.views, where), scene.points, scene.background, scene.normalization
    if twice := [name for name, count in Counter(v.name for v in views).items() if count > 1]:
        raise DataError(f"{where}view {twice[0]!r}: name must be unique; got two views of this name; rename or remove one")
    if points is not None:
        points = _checked_points(f"{of}points", points, {v.name for v in views})
    numbers = isinstance(background, (tuple, list)) and all(isinstance(c, (int, float, np.number)) for c in background)
    given = np.asarray(background, np.float64) if numbers else background
    colors = _numbers(f"{of}background", given, (3,), "give (red, green, blue)", kind=np.float64)
    _check(f"{of}normalization", n, Normalization, "give Normalization(offset, scale)")
    offset = _numbers(f"{of}normalization.offset", n.offset, (3,), "give three numbers", -math.inf, math.inf, np.float64)
    if not (isinstance(n.scale, (int, float, np.number)) and 0 < n.scale <= MOST):
        raise _wrong(f"{of}normalization.scale", "a number above 0", repr(n.scale), "give scene units per file unit, or 1.0")
    return _with(
        scene, views=scene.views if [*map(id, scene.views)] == [*map(id, views)] else tuple(views), notes=tuple(scene.notes),
        points=points, background=background if isinstance(background, tuple) else tuple(map(float, colors)),
        normalization=_with(n, offset=offset),
    )  # fmt: skip


def checked_views(views: Iterable[View], where: str = "") -> list[View]:
    """Return views whose fields are all valid, in their order."""
    if isinstance(views, (View, Scene, np.ndarray)) or not isinstance(views, Iterable):
        raise _wrong(f"{where}views", "a list of View", type(views).__name__, "give [view], or scene.views")
    with ThreadPoolExecutor() as pool:  # an error is that of the first view that has one
        return list(pool.map(lambda row: _checked_view(f"{where}views[{row[0]}]", row[1], where), enumerate(views)))


def _checked_view(what: str, view: View, where: str) -> View:
    """Return a valid view; ``what`` names it until its own name is known."""
    _check(what, view, View, "give View(name, camera, image)")
    _check(f"{what}.name", view.name, str, "give str(name)")
    if not view.name:
        raise _wrong(f"{what}.name", "the path of its image", "''", "give each view its own, such as 'a.png'")
    of = f"{where}view {view.name!r}: "
    camera = _checked_camera(f"{of}camera", view.camera)
    size, depth, alpha, normals = (camera.height, camera.width), view.depth, view.alpha, view.normals
    image = _numbers(f"{of}image", view.image, (*size, 3))
    masks = {name: _checked_mask(of + name, getattr(view, name), size) for name in ("mask", "score_mask")}
    if alpha is not None:
        alpha = _numbers(f"{of}alpha", alpha, size)
    _check(f"{of}alpha_estimated", view.alpha_estimated, (bool, np.bool_), "give True or False")
    if depth is not None:
        _check(f"{of}depth", depth, GivenDepth, "give GivenDepth(depth)")
        if not isinstance(depth.kind, str) or depth.kind not in DEPTH_KINDS:
            raise _wrong(f"{of}depth.kind", "the meaning of the values", repr(depth.kind), f"give {', '.join(DEPTH_KINDS)}")
        sure = depth.confidence
        sure = None if sure is None else _numbers(f"{of}depth.confidence", sure, size)
        depth = _with(depth, values=_numbers(f"{of}depth.values", depth.values, size, high=MOST), confidence=sure)
    if normals is not None:
        normals = _checked_normals(f"{of}normals", normals, camera)
    return _with(view, camera=camera, image=image, **masks, alpha=alpha, depth=depth, normals=normals)


def _checked_camera(what: str, camera: Camera) -> Camera:
    """Return a valid camera of one view, with numpy arrays."""
    _check(what, camera, Camera, "give Camera(viewmat, K, width, height)")
    for name in ("width", "height"):
        pixels = getattr(camera, name)
        if not isinstance(pixels, (int, np.integer)) or isinstance(pixels, bool) or not 1 <= pixels < 2**31:
            raise _wrong(f"{what}.{name}", "a whole number of pixels", repr(pixels), f"give int({name}), at least 1")
    _check(f"{what}.model", camera.model, str, "give its name, such as 'pinhole'")

    def matrix(name: str, value: Any, shape: tuple[int, ...], fix: str) -> np.ndarray:
        return _numbers(f"{what}.{name}", value, shape, fix, -math.inf, math.inf, None)

    viewmat = matrix("viewmat", camera.viewmat, (4, 4), "give camera_from_world, [R t] above the row 0, 0, 0, 1")
    K, R, lens = matrix("K", camera.K, (3, 3), INTRINSICS), viewmat[:3, :3].astype(np.float64), camera.distortion
    with np.errstate(over="ignore", invalid="ignore"):
        off = float(np.abs(R @ R.T - np.eye(3)).max())
        turns = np.linalg.det(R) > 0
    near = np.abs(viewmat[3] - (0, 0, 0, 1)).max() <= POSE_TOLERANCE
    plain = max(abs(K[0, 1]), abs(K[1, 0]), *np.abs(K[2] - (0, 0, 1))) <= K_TOLERANCE
    focal, least = np.abs([K[0, 0], K[1, 1]]), MIN_FOCAL * np.array([camera.width, camera.height])
    in_pixels = focal.all() and (camera.model not in ("pinhole", "opencv") or (focal >= least).all())
    count = COEFFICIENTS.get(camera.model)
    for good, name, needs, got, fix in (
        (near, "viewmat", "a pose above 0, 0, 0, 1", f"{viewmat[3].tolist()}", "transpose it: viewmat.T"),
        (off <= POSE_TOLERANCE, "viewmat", "rigid", f"R R^T off by {off:.2g} from 1", "divide its scale out of R and t"),
        (turns, "viewmat", "a rotation", "a mirrored pose (determinant -1)", "for OpenGL axes, negate rows y and z"),
        (plain, "K", "without skew, above 0, 0, 1", f"{K.tolist()}", f"divide K by K[2, 2], or undistort images; {INTRINSICS}"),
        (in_pixels, "K", "in pixels", f"focal lengths {K[0, 0]:g} and {K[1, 1]:g}",
         "multiply normalised intrinsics by width (first row) and height (second row)"),
        (count != 0 or lens is None, "distortion", f"None for model {camera.model}", "a value", "give None, or model='opencv'"),
    ):  # fmt: skip
        if not good:
            raise _wrong(f"{what}.{name}", needs, got, fix)
    if count:
        given = np.zeros(0) if lens is None else lens
        lens = matrix("distortion", given, (count,), f"give {count} coefficients, np.zeros({count}) for an ideal lens")
    return _with(camera, viewmat=viewmat, K=K, distortion=lens)


def _checked_mask(what: str, value: Any, shape: tuple[int, int]) -> np.ndarray | None:
    """Return a valid mask as a contiguous array, the same object if it is one; None for None."""
    if value is None:
        return None
    noun, needs = what.rpartition(" ")[2], f"bool, True where used, shape {list(shape)}"
    mask = _plain(what, value, shape, needs, f"np.asarray({noun}) > 0")
    if mask.dtype != bool:
        raise _wrong(what, needs, f"{mask.dtype}", f"give {noun} > 0")
    if not mask.any():
        raise _wrong(what, needs, "False everywhere", f"give ~{noun} if it is inverted, else None")
    return np.ascontiguousarray(mask)


def _checked_normals(what: str, value: Any, camera: Camera) -> np.ndarray:
    """Return valid normals of a camera [H, W, 3]: at most of length 1, most of them towards the camera."""
    normals = _numbers(what, value, (camera.height, camera.width, 3), low=-1)
    squares = np.einsum("...i,...i", normals, normals)
    if squares.max() > (1 + 10 * SLACK) ** 2:
        length = f"a length of {math.sqrt(squares.max()):.4g}"
        raise _wrong(what, "unit vectors, or 0 where missing", length, "divide them by their length; decode colours first")
    if camera.model == "pinhole":
        K, x, y = camera.K, np.arange(0, camera.width, 4) + 0.5, np.arange(0, camera.height, 4)[:, None] + 0.5
        part = normals[::4, ::4]  # enough for a fraction of the pixels
        along = part[..., 0] * ((x - K[0, 2]) / K[0, 0]) + part[..., 1] * ((y - K[1, 2]) / K[1, 1]) + part[..., 2]
        if np.count_nonzero(along > 0) > 0.5 * np.count_nonzero(squares[::4, ::4]):
            raise _wrong(what, "turned towards the camera", "most facing away", "give normals * np.float32([1, -1, -1])")
    return normals


def _checked_points(what: str, cloud: PointCloud, names: set[str]) -> PointCloud:
    """Return a valid point cloud; ``names`` are those of the views."""
    _check(what, cloud, PointCloud, "give PointCloud(points, colors)")
    xyz, tracks, unbounded = cloud.points, cloud.tracks, (-math.inf, math.inf, np.float64)
    count = len(xyz) if isinstance(xyz, Sized) and getattr(xyz, "shape", True) else 0  # 0 for an array without axes
    points = _numbers(f"{what}.points", xyz, (count, 3), "give a row x, y, z for each point", *unbounded)
    colors = _numbers(f"{what}.colors", cloud.colors, (count, 3), "give a row r, g, b for each point")
    if tracks is not None:
        _check(f"{what}.tracks", tracks, (tuple, list), "give a frozenset of view names for each point, or None")
        seen = set().union(*tracks) if all(isinstance(t, (set, frozenset)) for t in tracks) else None
        if seen is None or len(tracks) != count or (seen and not seen & names):
            needs, got = f"{count} sets of View.name", f"{len(tracks)}, such as {next(iter(tracks), None)!r}"
            raise _wrong(f"{what}.tracks", needs, got, "give a frozenset of view names for each point, or None")
    return _with(cloud, points=points, colors=colors)


def _numbers(
    what: str, value: Any, shape: tuple[int, ...], fix: str = "", low: float = 0.0, high: float = 1.0, kind: Any = np.float32
) -> np.ndarray:
    """Return an array in [low, high] as a contiguous array of a ``kind``, the same object if it is one.

    If ``kind`` is None, float32 and float64 stay as they are.
    """
    noun = what.rpartition(" ")[2]
    span = "finite" if high == math.inf else "finite, at least 0" if high == MOST else f"in [{low:g}, {high:g}]"
    needs = f"{np.dtype(kind)}, {span}, shape {list(shape)}"  # float64 for None
    array = _plain(what, value, shape, needs, f"np.asarray({noun}, np.{np.dtype(kind)})", fix)
    real = array.dtype in (np.float32, np.float64) if kind is None else array.dtype.kind == "f"
    least, most = (float(array.min()), float(array.max())) if array.size and array.dtype.kind in "fiu" else (0, 0)
    if not (real and low - SLACK <= least and most <= high + SLACK and math.isfinite(least) and math.isfinite(most)):
        got = f"{array.dtype} from {least:.6g} to {most:.6g}" if array.dtype.kind in "fiu" else f"{array.dtype}"
        raise _wrong(what, needs, got, _value_fix(noun, real, least, most, low, high))
    return array if kind is None else np.ascontiguousarray(array, kind)


def _plain(what: str, value: Any, shape: tuple[int, ...], needs: str, cast: str, fix: str = "") -> np.ndarray:
    """Return a numpy array of a shape, or a tensor as one; readers know no torch, so its methods tell a tensor."""
    noun = what.rpartition(" ")[2]
    if hasattr(value, "detach") and hasattr(value, "numpy"):
        try:
            value = np.asarray(value.detach().cpu().numpy())
        except (TypeError, RuntimeError) as e:  # bfloat16, sparse
            raise _wrong(what, needs, f"a tensor of {value.dtype}", "give a dense tensor, or .float()") from e
    if isinstance(value, np.ma.MaskedArray):
        raise _wrong(what, needs, "MaskedArray", f"give {noun}.data, and its mask as View.mask")
    if not isinstance(value, np.ndarray):
        raise _wrong(what, needs, type(value).__name__, "give an array" if value is None else f"give {cast}")
    if value.shape != shape:
        fix = fix or f"put channels last, without further axes, or resize it to the camera's {shape[1]} x {shape[0]} px"
        raise _wrong(what, needs, f"shape {list(value.shape)}", fix)
    return value


def _check(what: str, value: object, kind: type | tuple[type, ...], fix: str) -> None:
    """Check that a value is of a type."""
    if not isinstance(value, kind):
        name = kind[0].__name__ if isinstance(kind, tuple) else kind.__name__
        raise _wrong(what, f"of type {name}", type(value).__name__, fix)


def _wrong(what: str, needs: str, got: str, fix: str) -> DataError:
    """Return the error for the field ``what``."""
    return DataError(f"{what} must be {needs}; got {got}; {fix}")


def _with(record: Record, **fields: Any) -> Record:
    """Return a record with other fields; the same object if all of them are the same."""
    changed = {name: value for name, value in fields.items() if value is not getattr(record, name)}
    return replace(record, **changed) if changed else record


def _value_fix(noun: str, real: bool, least: float, most: float, low: float, high: float) -> str:
    """Return the fix for an array of another type, or with values from ``least`` to ``most`` outside of [low, high]."""
    if not math.isfinite(least + most):
        return f"estimate it again, or replace what is not finite: np.nan_to_num({noun}, posinf=0, neginf=0)"
    if high == 1 and most > (16 if real else 1):
        return f"divide by its full scale: {noun}.astype(np.float32) / {255 if most <= 256 else 65535}"
    if (low, high) == (0, 1) and -1.001 <= least < -0.5:
        return f"from [-1, 1] to [0, 1]: ({noun} + 1) / 2"
    if not real:
        return f"give floats: {noun}.astype(np.float32), in the unit of the cameras, or decoded from colours"
    return f"set missing values to 0: np.maximum({noun}, 0)" if high == MOST else f"clip it: np.clip({noun}, {low:g}, {high:g})"
