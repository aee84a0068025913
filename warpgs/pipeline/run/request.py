"""Requests for a fit, with their scene and device."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path

import torch

from warpgs.errors import ResourceError, UsageError
from warpgs.io.folder import image_scale
from warpgs.io.images import MAX_PIXELS
from warpgs.io.load import Split, coincident_views, load_scene, split_views
from warpgs.pipeline.train.settings import FitConfig
from warpgs.scene import Scene

CPU_MAX_SIDE = 800
"""Default of the longest side of an image [px] for a fit on a CPU. Compared with 1600 px, four times as many steps fit into the
time limit, and held-out PSNR at full size rises (decision 018)."""
NO_SCORES = "no photograph is held out, so new views get no score; hold some out with --split every:8"
"""Note on a fit without held-out views."""


@dataclass(frozen=True)
class SceneRequest:
    """A scene folder with options for reading it."""

    path: str
    """Scene folder in a supported format; or a folder of photographs or a video, without cameras."""
    # empty where a scene was passed from Python
    split: str | None = None
    """Views to hold out for scores: llff:K, mip360:K, dtu:3|6|9, blender:8, every:N, all (all views train), or
    train=NAMES;test=NAMES. None: a fit trains on all views; a study holds out every 8th view or the middle one."""
    downscale: int | None = None
    """Factor by which both image sides shrink; None for 1."""
    strict: bool = False
    """Treat a frame without an image file as an error."""
    allow_outside: bool = False
    """Allow names and links that point to files outside the scene folder."""
    masks: str = "ignore"
    """Treatment of masked-out pixels: ignore (left out of fit and scores) or cutout (transparent)."""
    mask_keeps: str = "white"
    """Colour of a mask file that keeps a pixel: white or black."""
    black_is_empty: bool = True
    """Make dark pixels around the object transparent, if every image shows an object on a black background."""
    score_masks: str | None = None
    """Folder of object masks for scoring, matched by image id; None for the scene's own idrmasks, if any."""
    reader: str | None = None
    """Name of the scene's format, or your own reader as module:Class or path/to/file.py:Class; None to detect the format."""
    max_pixels: int = MAX_PIXELS
    """Largest number of pixels of a stored image or mask."""
    max_side: int | None = None
    """Largest image side [px], 0 for no limit. None: no limit with --downscale; otherwise 1600, or 800 in a fit on a CPU."""
    lenses: str = "undistort"
    """Treatment of lens distortion: undistort (images are resampled to a pinhole) or native (the model is rendered through the
    lens). Fisheyes need native."""
    depths: str | None = None
    """Folder of depth maps, 16-bit PNG or NPY, with the names of the images. They place the first Gaussians and guide the fit.
    Default: the maps that transforms.json names; with the value none, these maps are ignored."""
    normals: str | None = None
    """Folder of normal maps, RGB PNG of (n + 1) / 2 or NPY, with the names of the images."""
    depth_kind: str = "metric"
    """Meaning of the depth maps: metric (lengths in units of the cameras), relative (lengths of unknown scale and shift) or
    disparity (inverse lengths of unknown scale and shift, as networks give)."""
    depth_unit: float | None = None
    """Length of one unit of a metric depth map, in units of the cameras. None: 0.001 for integer maps, 1 for float maps."""
    normal_axes: str = "opencv"
    """Camera axes of the normals: opencv (y down, z forward) or opengl (y up, z back)."""
    matcher: str | None = None
    """ONNX file of `warpgs priors export --model xfeat`, used if SIFT leaves photographs without a pose; None: SIFT only."""

    def with_scale(self, device: str) -> SceneRequest:
        """Return this request with default image sizes resolved for ``device``, cpu or cuda, to store it with a run."""
        side = CPU_MAX_SIDE if device == "cpu" and self.max_side is None and self.downscale is None else self.max_side
        downscale, max_side = image_scale(self.downscale, side)
        return replace(self, downscale=downscale, max_side=max_side)


@dataclass(frozen=True)
class FitRequest:
    """A fit that the command line or a study requests."""

    scene: SceneRequest
    out: Path
    """Run folder to fill."""
    config: FitConfig
    device: str
    """auto, cpu or cuda."""
    resume: bool = False
    """Continue the run in ``out`` from its last checkpoint."""
    lpips_weights: Path | None = None
    """File of `warpgs convert-lpips`; None to leave LPIPS out."""
    time_budget: float | None = None
    """Time that the fit may take [s], which determines the number of steps; None to use ``config``. Not with ``resume``."""
    notes: tuple[str, ...] = ()
    """Choices made for the user while the request was read."""
    view_port: int | None = None
    """Port of the viewer that the command line opens during the fit; None for no viewer."""


def check_overrides(overrides: Mapping[str, object]) -> None:
    """Check that keywords of a fit are not options of `load_scene`."""
    for name in overrides.keys() & {f.name for f in fields(SceneRequest)}:
        raise UsageError(f"warpgs.fit: {name} is an option for reading a scene; pass it to load_scene, and fit the result")


def choose_device(name: str | torch.device) -> tuple[torch.device, str]:
    """Return the device for auto, cpu, cuda or cuda:N, or a given device itself, and a phrase for the user."""
    if isinstance(name, torch.device):
        device = name
    elif re.fullmatch(r"cuda:[0-9]{1,3}", name):
        device = torch.device(name)
    elif name not in ("auto", "cpu", "cuda"):
        raise UsageError(f"device {name!r} is not one of auto, cpu, cuda, cuda:N")
    else:
        device = torch.device("cuda" if name == "auto" and torch.cuda.is_available() else name.replace("auto", "cpu"))
    if device.type == "cpu":
        return device, f"on the CPU, {torch.get_num_threads()} thread{'s' if torch.get_num_threads() > 1 else ''}"
    if device.type != "cuda":
        raise UsageError(f"device {device} has no kernels: give auto, cpu, cuda or cuda:N")
    if not torch.cuda.is_available():
        raise ResourceError(
            "--device cuda: torch finds no CUDA device; run `warpgs doctor` for the reason, or use --device cpu"
        )
    if device.index is None:
        device = torch.device("cuda", torch.cuda.current_device())
    return device, f"on {torch.cuda.get_device_name(device)}"


def choose_split(scene: Scene, spec: str | None) -> tuple[Split, list[str]]:
    """Split a scene by ``spec`` (None: all views train); returns the split and notes on doubtful scores."""
    split = split_views(scene, "all" if spec is None else spec)
    notes = [] if split.test else [NO_SCORES]
    if (spec or "").startswith("dtu:") and any(v.mask is not None for v in scene.views):
        notes.append(
            "masks hide pixels from the fit, unlike in the published DTU protocol; put object masks for scoring only into a "
            "folder idrmasks, or give them with --score-masks"
        )
    for test, train in coincident_views(scene, split):
        notes.append(f"{test} is held out, but training view {train} has the same pose, so this score does not test new views")
    return split, notes


def read_scene(request: SceneRequest, progress: Callable[[str], object] | None = None) -> tuple[Scene, Split, list[str]]:
    """Load a scene and split its views; returns both with the notes for the user. ``progress`` is as in `load_scene`."""
    options = {f.name: getattr(request, f.name) for f in fields(request) if f.name not in ("path", "split", "matcher")}
    scene = load_scene(request.path, **options, progress=progress)
    split, notes = choose_split(scene, request.split)
    return scene, split, [*scene.notes, *notes]
