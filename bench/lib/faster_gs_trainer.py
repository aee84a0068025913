"""Faster-GS's own trainer, model and loss, run without the framework that they are written for.

Its files are imported, never copied: ``Trainer.py``, ``Model.py`` and ``Loss.py`` of nerficg-project/faster-gaussian-splatting
at 3cb0b75, around its package ``FasterGSCudaBackend``; and the optimizer's tables, rates, callbacks and sampler of
nerficg-project/nerficg at c743712, whose folder ``src`` is on the path. What they ask of the rest of NeRFICG is made here:
cameras, views on the device, SSIM (fused, as in theirs), distances to neighbours, and the loop that calls the callbacks.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import torch

from warpgs.geometry import rotation_matrices
from warpgs.kernels.neighbours import mean_square_distances
from warpgs.kernels.ssim import ssim
from warpgs.scene import C0, Gaussians, Scene, View

FULL_STEPS = 30_000
"""Length of the schedule that its settings belong to."""
NEAR, FAR = 0.2, 10_000.0
"""Its clipping planes, in the units of the files."""
Watch = Callable[[int, Callable[[View], np.ndarray]], object]
"""Called after each step with the number of steps, and with what draws the image of a view."""


class _Anything(type):
    """A class that has every attribute: a stand-in for what is imported and never called."""

    def __getattr__(cls, name: str):
        return cls


_NOTHING = _Anything("_NOTHING", (), {})


def _stand_in(name: str, **contents) -> None:
    def missing(key: str) -> type:
        if key.startswith("__"):
            raise AttributeError(key)
        return _NOTHING

    sys.modules[name] = module = ModuleType(name)
    module.__dict__.update({"__path__": [], "__getattr__": missing} | contents)


def _configured(**settings):
    return lambda kind: [setattr(kind, name, value) for name, value in settings.items()] and kind


def _morton(means: torch.Tensor) -> torch.Tensor:
    """Return the Morton codes of positions [N, 3] on a grid of 2^21 cells a side."""
    low, high = means.amin(0), means.amax(0)
    cells = ((means - low) / (high - low).amax()).clamp(0, 1).mul(2**21 - 1).long()
    bits = [(cells[:, axis] >> bit & 1) << (3 * bit + axis) for bit in range(21) for axis in range(3)]
    return torch.stack(bits).sum(0)


def _neighbours(points: torch.Tensor) -> torch.Tensor:
    with torch.device("cpu"):
        return mean_square_distances(points).clamp_min(1e-7).sqrt()


def _dssim(input: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    return 1 - ssim(*(t.permute(1, 2, 0).contiguous() for t in (input, target))).mean()


def load() -> SimpleNamespace:
    """Import its files, once; return the modules of its trainer, its model and its rasterizer."""
    if "Methods.FasterGS.Trainer" not in sys.modules:
        home = Path(importlib.import_module("FasterGSCudaBackend.torch_bindings").__path__[0]).parents[2]
        base = next(Path(p, "Methods/Base") for p in sys.path if Path(p, "Methods/Base/utils.py").is_file())
        off = SimpleNamespace(TRAINING=SimpleNamespace(WANDB=SimpleNamespace(ACTIVATE=False)))
        own = SimpleNamespace(configure=_configured)
        _stand_in("Framework", Configurable=own, ConfigParameterList=SimpleNamespace, config=off)
        _stand_in("Logging", Logger=SimpleNamespace(log_info=lambda words: None, log_warning=lambda words: None))
        _stand_in("Cameras.utils", quaternion_to_rotation_matrix=lambda q: rotation_matrices(torch.nn.functional.normalize(q)))
        _stand_in("CudaUtils.MortonEncoding", morton_encode=_morton)
        _stand_in("Optim.knn_utils", compute_root_mean_squared_knn_distances=_neighbours)
        _stand_in("Optim.Losses.DSSIM", fused_dssim=_dssim)
        _stand_in("Methods.Base", __path__=[str(base)])
        _stand_in("Methods.Base.GuiTrainer", GuiTrainer=object)
        _stand_in("Methods.Base.Model", BaseModel=object)
        _stand_in("Methods.FasterGS", __path__=[str(home)])
        others = [
            "Cameras",
            "Cameras.Perspective",
            "CudaUtils",
            "Datasets",
            "Datasets.Base",
            "Datasets.utils",
            "Methods",
            "Optim.ppisp",
        ]
        for name in (*others, *(["torchmetrics"] if importlib.util.find_spec("torchmetrics") is None else [])):
            _stand_in(name)
    names = ("Trainer", "Model", "FasterGSCudaBackend")
    return SimpleNamespace(**{n: importlib.import_module(f"Methods.FasterGS.{n}") for n in names})


class _Views(list):
    """Views as its trainer takes them, of which it trains on all."""

    mode = "train"

    def train(self) -> _Views:
        return self


def _view(view: View, scene: Scene, device: torch.device) -> SimpleNamespace:
    """Return a view on the device, in the units of the files."""
    viewmat, n = np.array(view.camera.viewmat, dtype=np.float64), scene.normalization  # of (x - offset) * scale
    viewmat[:3, 3] = viewmat[:3, 3] / n.scale - viewmat[:3, :3] @ n.offset
    arrays = (-viewmat[:3, :3].T @ viewmat[:3, 3], viewmat, view.image.transpose(2, 0, 1), np.zeros(3))
    place, w2c, image, black = (torch.as_tensor(a, dtype=torch.float32, device=device).contiguous() for a in arrays)
    (fx, _, cx), (_, fy, cy), _ = view.camera.K.tolist()
    lens = (view.camera.width, view.camera.height, fx, fy, cx, cy, NEAR, FAR)
    camera = SimpleNamespace(background_color=black, lens=lens)
    return SimpleNamespace(w2c=w2c, position=place, rgb=image, alpha=None, camera=camera)


class _Renderer:
    """Its renderer, without what only other settings use."""

    def __init__(self, backend: ModuleType, gaussians) -> None:
        self.backend, self.gaussians = backend, gaussians

    def _inputs(self, view: SimpleNamespace, background: torch.Tensor) -> tuple[list[torch.Tensor], object]:
        g = self.gaussians
        given = [g.means, g.raw_scales, g.raw_rotations, g.raw_opacities, g.sh_coefficients_0, g.sh_coefficients_rest]
        eye = (view.w2c, view.position, background, g.active_sh_bases)
        return given, self.backend.RasterizerSettings(*eye, *view.camera.lens, False)

    def render_image_training(self, view, update_densification_info: bool, bg_color: torch.Tensor) -> torch.Tensor:
        given, settings = self._inputs(view, bg_color)
        info = self.gaussians.densification_info if update_densification_info else torch.empty(0)
        return self.backend.diff_rasterize(*given, info, settings)

    @torch.no_grad()
    def image(self, view: SimpleNamespace) -> np.ndarray:
        given, settings = self._inputs(view, view.camera.background_color)
        return self.backend.rasterize(*given, settings, to_chw=False, clamp_output=True).cpu().numpy()


def _scaled(trainer, factor: float) -> list[tuple]:
    """Scale the trainer's numbers of steps; return the callbacks of a step by priority, each with first, last and stride."""
    found = []
    for name in {n for n in dir(trainer) if n.endswith(("_ITERATION", "_INTERVAL"))}:
        setattr(trainer, name, max(1, round(factor * getattr(trainer, name))))
    for call in (k for k in vars(type(trainer)).values() if getattr(k, "callback_type", None) == 0 and k.active is True):
        times = [call.start_iteration or 0, call.end_iteration, call.iteration_stride or 1]
        whole = [t if t in (None, 0, 1) or isinstance(t, str) else max(1, round(factor * t)) for t in times]
        found.append((call, *(getattr(trainer, t) if isinstance(t, str) else t for t in whole)))
    return sorted(found, key=lambda c: -c[0].priority)


def train(
    scene: Scene, train_views: list[View], first: Gaussians, steps: int, *, seed: int, watch: Watch = lambda step, image: None
) -> tuple[int, Callable[[View], np.ndarray]]:
    """Train from the positions and colours of the first Gaussians, with all numbers of steps in proportion.

    Returns the number of Gaussians, and what draws the image [H, W, 3] of a view.
    """
    torch.manual_seed(seed)
    own, n, device = load(), scene.normalization, first.means.device
    views = _Views(_view(v, scene, device) for v in train_views)
    views.default_camera = views[0].camera
    places = first.means.detach() / n.scale + torch.as_tensor(n.offset, dtype=torch.float32, device=device)
    views.point_cloud = SimpleNamespace(positions=places, colors=C0 * first.sh.detach()[:, 0] + 0.5)
    trainer, gaussians = object.__new__(own.Trainer.FasterGSTrainer), own.Model.Gaussians(3, pretrained=False)
    trainer.requires_empty_cache = not own.Trainer.enable_expandable_segments()
    calls = _scaled(trainer, steps / FULL_STEPS)
    trainer.OPTIMIZER = SimpleNamespace(**vars(trainer.OPTIMIZER) | {"LEARNING_RATE_MEANS_MAX_STEPS": steps})
    trainer.model = SimpleNamespace(gaussians=gaussians, ppisp=None, train=lambda: None)
    trainer.renderer = _Renderer(own.FasterGSCudaBackend, gaussians)
    with device:  # new tensors lie there; in its framework always, which would only slow its steps down
        trainer.create_sampler(None, views)
        trainer.setup_gaussians(None, views)

    def image(view: View) -> np.ndarray:
        return trainer.renderer.image(_view(view, scene, device))

    for step in range(steps):
        for call, begin, end, stride in calls:
            if begin <= step <= (step if end is None else end) and (step - begin) % stride == 0:
                call(trainer, step, views)
        watch(step + 1, image)
    return gaussians.training_cleanup(trainer.MIN_OPACITY_AFTER_TRAINING), image
