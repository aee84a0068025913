"""Requests for a fit, with their scene and device."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path

import torch

from warpgs.errors import ResourceError, UsageError
from warpgs.io.images import SceneOptions, image_scale
from warpgs.io.load import Split, coincident_views, read_folder, split_views
from warpgs.pipeline.train.settings import FitConfig
from warpgs.process import Say
from warpgs.scene import Scene

CPU_MAX_SIDE = 800
"""Default of the longest side of an image [px] for a fit on a CPU. Compared with 1600 px, four times as many steps fit into the
time limit, and held-out PSNR at full size rises (decision 018)."""
NO_SCORES = "no photograph is held out, so new views get no score; hold some out with --split every:8"
"""Note on a fit without held-out views."""


@dataclass(frozen=True)
class SceneRequest(SceneOptions):
    """A scene folder with options for reading it."""

    path: str
    """Scene folder in a supported format; or a folder of photographs or a video, without cameras."""
    # empty where a scene was passed from Python
    split: str | None = None
    """Views to hold out for scores: llff:K, mip360:K, dtu:3|6|9, blender:8, every:N, all (all views train), or
    train=NAMES;test=NAMES. None: a fit trains on all views; a study holds out every 8th view or the middle one."""
    reader: str | None = None
    """Name of the scene's format, or your own reader as module:Class or path/to/file.py:Class; None to detect the format."""
    matcher: str | None = None
    """ONNX file of `warpgs priors export --model xfeat`, used if SIFT leaves photographs without a pose; None: SIFT only."""

    def with_scale(self, device: str) -> "SceneRequest":
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
    if isinstance(name, torch.device) or re.fullmatch(r"cuda:[0-9]{1,3}", name):
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
        raise ResourceError("--device cuda: torch finds no CUDA device; `warpgs doctor` tells why; or use --device cpu")
    if device.index is None:
        device = torch.device("cuda", torch.cuda.current_device())
    return device, f"on {torch.cuda.get_device_name(device)}"


def choose_split(scene: Scene, spec: str | None) -> tuple[Split, list[str]]:
    """Split a scene by ``spec`` (None: all views train); returns the split and notes on doubtful scores."""
    split = split_views(scene, "all" if spec is None else spec)
    notes = [] if split.test else [NO_SCORES]
    for test, train in coincident_views(scene, split):
        notes.append(f"{test} is held out, but training view {train} has the same pose, so this score does not test new views")
    return split, notes


def read_scene(request: SceneRequest, progress: Say | None = None, *, hashed: bool = True) -> tuple[Scene, Split, list[str]]:
    """Load a scene and split its views; returns both with the notes for the user. Arguments are those of `read_folder`."""
    scene = read_folder(request.path, request, request.reader, progress, hashed=hashed)
    split, notes = choose_split(scene, request.split)
    return scene, split, [*scene.notes, *notes]
