"""The step whose loss was not finite, in one small file: all that it takes to compute that loss again, without the scene."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from warpgs.errors import DataError
from warpgs.files import write_bytes
from warpgs.input_files import open_input
from warpgs.kernels.dropout import opacity_dropout
from warpgs.kernels.step_buffers import SHIFT
from warpgs.pipeline.runs.checkpoint import safetensors_chunks
from warpgs.pipeline.train.config import FitConfig
from warpgs.pipeline.train.exposure import EXPOSURE, exposed, exposure_of
from warpgs.pipeline.train.loss import Target, over
from warpgs.pipeline.train.setup import terms_of
from warpgs.pipeline.train.trainer import Trainer
from warpgs.pipeline.train.views import half_size
from warpgs.render.rasterize import RasterizeOptions, rasterize
from warpgs.scene import Camera, Gaussians, Render

FILE = "not_finite.safetensors"
"""Name of the file in a run folder."""

Bundle = tuple[dict[str, torch.Tensor], dict[str, Any]]
"""Tensors and plain values of such a step."""


def failed_step(trainer: Trainer, view: int, name: str, slot: int = 0) -> Bundle:
    """Return what the next step of a fit computes its loss from.

    Args:
        trainer: The fit, in the state before the step.
        view: Number of the step's view.
        name: Its name.
        slot: Its number among the views of the step.
    """
    trainer.show_learned()
    number, shown = trainer.step + 1, trainer.views[view]
    plan = trainer.plan_of(number)
    if plan.half_size:
        shown = half_size(shown)
    camera, settings = shown.camera, list(trainer.settings(number, slot))
    image, background = shown.image, trainer.background
    if shown.alpha is not None:  # over the colour that the step had behind it
        shift = torch.tensor(settings[SHIFT], dtype=torch.float32, device=image.device)
        image, background = over(image, shown.alpha, shift), background + shift
    tensors = {"image": image, "viewmat": camera.viewmat, "K": camera.K, "background": background}
    if camera.distortion is not None:
        tensors["distortion"] = camera.distortion
    tensors |= {f"params.{n}": t for n, t in trainer.gaussians.tensors().items()}
    tensors |= {f"maps.{n}": t for n, t in shown.maps.items()}
    tensors |= {f"own.{n}": t.detach()[view] for n, t in trainer.view_table.params.items()}
    if (own := trainer.view_table.params.get(EXPOSURE)) is not None:
        tensors[f"own.{EXPOSURE}"] = exposure_of(own, own[view]).detach()
    if shown.mask is not None:
        tensors["mask"] = shown.mask
    if shown.alpha is not None:
        tensors["alpha"] = shown.alpha
    plain = {
        "config": trainer.config.to_json(), "step": number, "view": name, "width": camera.width, "height": camera.height,
        "camera_model": camera.model, "degree": plan.degree, "settings": settings, "dropout_seed": trainer.learned.dropout_seed,
    }  # fmt: skip
    return tensors, plain


def save_failed_step(path: Path, bundle: Bundle) -> None:
    """Write a failed step as a safetensors file, whose header holds the plain values.

    Raises:
        ResourceError: The file cannot be written.
    """
    write_bytes(path, *safetensors_chunks(bundle[0], {"step": json.dumps(bundle[1])}))


def read_failed_step(path: Path, device: torch.device) -> Bundle:
    """Read what `save_failed_step` wrote, tensors of shape [...] on a device.

    Raises:
        DataError: The file is not there or is another.
    """
    from safetensors import SafetensorError, safe_open

    try:
        open_input(path).close()
        with safe_open(path, framework="pt", device=str(device)) as f:
            return {n: f.get_tensor(n) for n in f.keys()}, json.loads((f.metadata() or {})["step"])
    except (OSError, SafetensorError, KeyError, ValueError, RecursionError) as e:
        raise DataError(f"{path}: is no step that failed ({e}); give the {FILE} of a run folder") from e


def findings(bundle: Bundle) -> list[str]:
    """Compute a failed step again; returns a line for everything that it reads and computes, and whether that is finite.

    Terms of the loss from outside warpgs are computed where their modules are loaded. What the strategy adds to the loss is
    not computed.

    Raises:
        DataError: A tensor or a value is missing or of another shape.
    """
    tensors, plain = bundle
    try:
        config = FitConfig.from_json(plain["config"])
        gaussians = Gaussians(**{n: tensors[f"params.{n}"].requires_grad_() for n in Gaussians.__dataclass_fields__})
        parts = {p: {n.removeprefix(f"{p}."): t for n, t in tensors.items() if n.startswith(f"{p}.")} for p in ("maps", "own")}
        target = Target(tensors["image"], tensors.get("mask"), parts["maps"], parts["own"], tensors.get("alpha"))
        lines = [
            f"step {plain['step']} on {plain['view']}, {plain['width']} x {plain['height']} px, {len(gaussians):,} Gaussians"
        ]
        lines += [f"  {name}: {_state(t)}" for name, t in tensors.items()]
        render = _rendered(gaussians, bundle, config)
        lines += [f"  rendered {n}: {_state(getattr(render, n))}" for n in ("rgb", "alpha", "depth")]
        if config.exposure:
            render = replace(render, rgb=exposed(render.rgb, parts["own"][EXPOSURE]))
        for term in terms_of(config, "alpha" in tensors):
            if term.active(plain["step"], config.steps):
                value = term(render, target, gaussians)
                lines.append(f"  loss term {term.name}: {float(value.detach()):g}")
                if not value.requires_grad:  # of the view's own parameters alone
                    continue
                of = torch.autograd.grad(value, list(gaussians.tensors().values()), retain_graph=True, allow_unused=True)
                broken = [n for n, g in zip(gaussians.tensors(), of) if g is not None and not bool(torch.isfinite(g).all())]
                lines += [f"    its gradient by {n} is not finite" for n in broken]
    except (KeyError, TypeError, ValueError, RuntimeError) as e:
        raise DataError(f"the failed step is not whole ({e!r}); fit again to have it written anew") from e
    return lines


def _rendered(gaussians: Gaussians, bundle: Bundle, config: FitConfig) -> Render:
    tensors, plain = bundle
    factors = None
    if plain["dropout_seed"] is not None:
        settings = torch.tensor(plain["settings"], dtype=torch.float32, device=gaussians.means.device)
        factors = opacity_dropout(len(gaussians), settings, plain["dropout_seed"])
    options = RasterizeOptions(
        rule=config.rule, sh_degree=plain["degree"], background=tensors["background"], opacity_factors=factors
    )
    size, model = (plain["width"], plain["height"]), plain.get("camera_model", "pinhole")
    camera = Camera(tensors["viewmat"], tensors["K"], *size, model, tensors.get("distortion"))
    return rasterize(gaussians, camera, options)


def _state(values: torch.Tensor) -> str:
    """Describe numbers: their range, or how many are not finite."""
    values = values.detach()
    if not values.numel():
        return "empty"
    bad = int((~torch.isfinite(values)).sum()) if values.is_floating_point() else 0
    if bad:
        return f"{bad:,} of {values.numel():,} NOT FINITE"
    return f"{float(values.min()):g} to {float(values.max()):g}"
