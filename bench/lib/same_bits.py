"""SHA-256 of every stage from photographs to the PLY of a fit: first of single library functions, then of three fits.

The demo scene is fitted by three presets: ``3dgs`` from the points of the scene, ``quick`` from swept depths, with saliency and
sampling events, and ``mcmc`` with relocation and noise. Single functions (``torch.exp``, ``cv2.SIFT``, ...) get fixed inputs,
so a difference comes from the function itself.
"""

from __future__ import annotations

import dataclasses
import hashlib
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

from bench.lib import result_file
from bench.lib.tables import markdown
from warpgs.export.ply import write_ply
from warpgs.io.load import load_scene, split_views
from warpgs.pipeline.train.loss import LossInputs, Target, outputs_of
from warpgs.pipeline.train.presets import PRESETS
from warpgs.pipeline.train.settings import FitConfig, settings_by_views
from warpgs.pipeline.train.step import total_loss
from warpgs.pipeline.train.trainer import Trainer, train_views
from warpgs.priors.flow import triangulate_matches
from warpgs.priors.views import classical_maps
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Gaussians, Scene, View
from warpgs.synthetic.demo import split_spec, write_demo

RESULTS = result_file.FOLDER / "same_bits.json"
PRESET_NAMES = ("3dgs", "quick", "mcmc")
DIGITS = 12
LIBRARIES = ("torch.", "numpy.", "cv2.")
"""Prefixes of the names of stages of single functions."""

Stage = tuple[str, str]


def digest(*parts: np.ndarray | torch.Tensor | bytes | None) -> str:
    """Return the first digits of the SHA-256 of arrays, with their shapes and types, and of bytes."""
    total = hashlib.sha256()
    for part in parts:
        if isinstance(part, torch.Tensor):
            part = part.detach().cpu().numpy()
        if isinstance(part, np.ndarray):
            total.update(f"{part.dtype}{part.shape}".encode())
            part = np.ascontiguousarray(part).tobytes()
        total.update(b"none" if part is None else part)
    return total.hexdigest()[:DIGITS]


def _numbers(count: int) -> np.ndarray:
    """Return pseudorandom float64 numbers in [0, 1), computed by integer products alone."""
    return (np.arange(count, dtype=np.int64) * 40503 % 65536) / 65536


def function_stages() -> Iterator[Stage]:
    """Yield the results of single functions of each library for fixed numbers."""
    import cv2

    x = _numbers(65_537)  # an odd number: the end of a vectorised loop is another loop
    t = torch.from_numpy((8 * x - 4).astype(np.float32))
    for name in ("exp", "log", "sigmoid", "sqrt", "sin", "log1p"):
        yield f"torch.{name}", digest(getattr(torch, name)(t.abs() if name in ("log", "sqrt", "log1p") else t))
    yield "torch.hypot", digest(torch.hypot(t[:-1], t[1:]))
    yield "torch.norm of 3", digest(t[:-2].view(-1, 3).norm(dim=-1))
    cubes = t * t * t  # whose sums are rounded
    yield "torch.sum", digest(cubes.sum())
    yield "torch.sum of rows", digest(cubes[:-1].view(-1, 32).sum(1))
    yield "torch.randn", digest(torch.randn(10_001, generator=torch.Generator().manual_seed(0)))
    yield "torch.matmul", digest(t[:4096].view(64, 64) @ t[4096:8192].view(64, 64))
    f = x.astype(np.float32)
    for name in ("exp", "log", "sin", "sqrt"):
        yield f"numpy.{name}", digest(getattr(np, name)(x + 0.5), getattr(np, name)(f + np.float32(0.5)))
    yield "numpy.sum", digest(x.sum(), f.sum(), (f - x).std())
    products = x[:4096].reshape(64, 64) @ x[4096:8192].reshape(64, 64), x[:30_000].reshape(-1, 3) @ x[:9].reshape(3, 3)
    yield "numpy.matmul", digest(*products)
    yield "numpy.linalg.inv", digest(np.linalg.inv(x[:16].reshape(4, 4) + np.eye(4)))
    image = f[: 240 * 240].reshape(240, 240)
    bytes3 = (255 * np.stack([image] * 3, 2)).astype(np.uint8)
    H = np.array([[1.01, 0.02, 3.3], [-0.01, 0.98, 1.7], [1e-5, -2e-5, 1]])
    linear = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    yield "cv2.blur", digest(cv2.blur(image, (7, 7)))
    yield "cv2.warpPerspective", digest(cv2.warpPerspective(image, H, (240, 240), flags=linear))
    yield "cv2.cvtColor", digest(cv2.cvtColor(np.stack([image, image.T, image[::-1]], 2), cv2.COLOR_RGB2GRAY))
    yield "cv2.resize", digest(cv2.resize(image, (100, 90), interpolation=cv2.INTER_AREA))
    smooth = cv2.GaussianBlur(bytes3[..., 0], (0, 0), 3)
    yield "cv2.GaussianBlur", digest(smooth)
    found, descriptors = cv2.SIFT_create().detectAndCompute(np.ascontiguousarray(smooth), None)
    yield "cv2.SIFT", digest(np.array([(*k.pt, k.size, k.angle) for k in found]), descriptors)
    yield "cv2.l0Smooth", digest(cv2.ximgproc.l0Smooth(bytes3[:120, :120], None, 0.04, 2.0))
    distances = cv2.distanceTransform((image > 0.01).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    yield "cv2.distanceTransform", digest(distances)
    yield "cv2.fastGlobalSmoother", digest(cv2.ximgproc.fastGlobalSmootherFilter(bytes3, image, 1e4, 8.0))


def scene_stages(scene: Scene, folder: Path) -> Iterator[Stage]:
    """Yield the files of the demo, and the data read from them."""
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    yield "demo photographs", digest(*(p.read_bytes() for p in files if p.suffix == ".png"))
    yield "demo cameras and points", digest(*(p.read_bytes() for p in files if p.suffix == ".txt"))
    yield "decoded images", digest(*(v.image for v in scene.views))
    yield "cameras", digest(*(a for v in scene.views for a in (v.camera.viewmat, v.camera.K)))
    yield "points", digest(scene.points.points, scene.points.colors)


def prior_stages(train: list[View]) -> Iterator[Stage]:
    """Yield the inputs of the classical priors."""
    matches = triangulate_matches(train)
    yield "triangulated matches", digest(matches.points, matches.colors)
    maps = classical_maps([v.image for v in train])
    for name, of_views in zip(("confidence", "boundary", "foreground"), zip(*maps)):
        yield f"semantics: {name}", digest(*of_views)


def _ply(gaussians: Gaussians, scene: Scene, folder: Path) -> str:
    path = folder / "point_cloud.ply"
    write_ply(path, gaussians, scene.normalization)
    return digest(path.read_bytes())


def _first_step(trainer: Trainer) -> Iterator[Stage]:
    """Yield the first render, its loss and the gradients, without a change to the fit."""
    view, plan = trainer.views[0], trainer.plan_of(1)
    leaves = Gaussians(**{n: t.clone().requires_grad_() for n, t in trainer.gaussians.tensors().items()})
    options = RasterizeOptions(rule=trainer.config.rule, sh_degree=plan.degree, background=trainer.background)
    render = rasterize(leaves, view.camera, options)
    for name, image in (("colour", render.rgb), ("alpha", render.alpha), ("depth", render.depth)):
        yield f"first render: {name}", digest(image)
    outputs = {n: getattr(render, n) for n in outputs_of(plan.terms)}
    target = Target(view.image, view.mask, view.maps, view.alpha)
    inputs = LossInputs(outputs, target, leaves, view.camera, torch.ones((), device=trainer.device))
    loss = total_loss(plan, inputs, trainer.strategy)
    yield "first loss", digest(loss)
    loss.backward()
    for name, leaf in leaves.tensors().items():
        yield f"first gradient: {name}", digest(leaf.grad)


def fit_stages(
    scene: Scene, train: list[View], config: FitConfig, device: torch.device, folder: Path, *, only_start: bool
) -> Iterator[Stage]:
    """Yield the stages of one fit: its start, the first step, parameters after 1, 10 and all steps, and both PLY files."""
    config, _ = settings_by_views(config, train, device.type)
    trainer = Trainer(train, scene.points, config, device, scene.background)
    if trainer.strategy.samples:
        yield "consistent depths", digest(*(v.consistent for v in trainer.views))
        yield "disparities", digest(*trainer.disparities)
    for name in sorted({name for v in trainer.views for name in v.maps}):
        yield f"maps of the loss: {name}", digest(*(v.maps[name] for v in trainer.views))
    yield "first points", digest(trainer.gaussians.means, trainer.gaussians.sh[:, 0])
    yield "first Gaussians", digest(*trainer.gaussians.tensors().values())
    yield "first PLY", _ply(trainer.gaussians, scene, folder)
    if only_start:
        return
    yield from _first_step(trainer)
    losses = []
    for step in sorted({1, min(10, config.steps), config.steps}):
        while trainer.step < step:
            losses += [report.loss for report in trainer.advance(step - trainer.step)]
        yield f"parameters after step {step}", digest(*trainer.gaussians.tensors().values())
    yield "losses", digest(np.array(losses))
    yield "last PLY", _ply(trainer.gaussians, scene, folder)


def stages(
    device: torch.device, *, views: int, width: int, height: int, steps: int, only_start: bool, given: Path | None = None
) -> Iterator[Stage]:
    """Yield names and digests of stages in their order of computation."""
    yield from function_stages()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        source = folder / "scene" if given is None else given
        if given is None:
            write_demo(source, views=views, width=width, height=height)
        scene = load_scene(str(source))
        train = train_views(scene, split_views(scene, split_spec(views)).train)
        yield from scene_stages(scene, source)
        yield from prior_stages(train)
        for preset in PRESET_NAMES:
            config = PRESETS[preset]
            # so that Gaussians are cloned, split and pruned in as few steps as these
            density = dataclasses.replace(config.density, start=steps // 6, every=max(1, steps // 6))
            config = dataclasses.replace(config, steps=steps, density=density)
            for stage, value in fit_stages(scene, train, config, device, folder, only_start=only_start):
                yield f"{preset}: {stage}", value


def placed(rows: list[dict], made: dict) -> list[dict]:
    """Return the rows with the new one, which replaces a row with the same label, processor and arguments."""

    def key(r: dict) -> tuple:
        return r["label"], r["machine"]["device"], r["machine"]["name"], r["arguments"]

    if key(made) in map(key, rows):
        return [made if key(r) == key(made) else r for r in rows]
    return [*rows, made]


def differing(one: dict, other: dict) -> list[str]:
    """Return the names of the stages whose digests differ between two rows, in order."""
    return [n for n, value in one["stages"].items() if other["stages"].get(n) != value]


def table(rows: list[dict]) -> str:
    """Return the table of docs/numerics.md: a row for each run, beside the first run on the same kind of device."""
    lines = []
    for r in rows:
        first = next(f for f in rows if f["machine"]["device"] == r["machine"]["device"])
        functions, others = [], []
        for name in differing(r, first):
            (functions if name.startswith(LIBRARIES) else others).append(name)
        threads = r["machine"]["threads"]
        how = f"{r['label']}, torch {r['versions']['torch']}, {threads} thread{'s' if threads > 1 else ''}"
        run = f"**{r['machine']['name']}**, {how}"
        lines.append([run, len(functions), others[0] if others else "none"])
    return markdown(["run", "functions that differ", "first stage that differs"], lines)
