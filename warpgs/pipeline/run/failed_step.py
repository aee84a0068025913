"""The step with a non-finite loss, in one small file, from which the loss can be computed again without the scene."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch

from warpgs.errors import DataError
from warpgs.files import open_input, unread_reason, write_bytes
from warpgs.pipeline.run.folder import safetensors_chunks
from warpgs.pipeline.train.loss import LOSS_TERMS, term_values
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.setup import terms_of
from warpgs.pipeline.train.step import Forward, StepBuffers, StepPlan, eager_renderer, forward
from warpgs.pipeline.train.trainer import Trainer
from warpgs.pipeline.train.views import LearnedViews, ViewStack
from warpgs.render.options import RasterizeOptions
from warpgs.scene import Gaussians

FILE = "not_finite.safetensors"
"""Name of the file in a run folder."""

Bundle = tuple[dict[str, torch.Tensor], dict[str, Any]]
"""Tensors and plain values of a step with a non-finite loss."""


def failed_step(trainer: Trainer, view: int, name: str, slot: int = 0) -> Bundle:
    """Return the inputs of the loss of the next step.

    Args:
        trainer: The fit, in the state before the step.
        view: Index of the step's view.
        name: Name of the view.
        slot: Index of the view among the step's views.
    """
    number = trainer.step + 1
    plan = trainer.plan_of(number)
    kind, row = trainer.places[view + plan.half_size * len(trainer.views)]
    stack = trainer.stacks[kind]
    tensors = {"image": stack.images[row], "viewmat": stack.viewmats[row], "K": stack.Ks[row], "background": trainer.background}
    if stack.distortions.numel():
        tensors["distortion"] = stack.distortions[row]
    if stack.masks is not None:
        tensors["mask"] = stack.masks[row]
    if stack.alphas is not None:
        tensors["alpha"] = stack.alphas[row]
    tensors |= {f"maps.{n}": t[row] for n, t in stack.maps.items()}
    tensors |= {f"params.{n}": t for n, t in trainer.gaussians.tensors().items()}
    learned = trainer.learned.views
    tensors |= {f"views.{m.name}.{n}": t.detach() for m in learned.modules for n, t in learned.params_of(m).items()}
    plain = {
        "config": trainer.config.to_json(), "step": number, "view": name, "number": view, "camera_model": stack.model,
        "degree": plan.degree, "settings": list(trainer.settings(number, slot)), "cutout": trainer.cutout,
        "dropout_seed": trainer.learned.dropout_seed,
    }  # fmt: skip
    return tensors, plain


def save_failed_step(path: Path, bundle: Bundle) -> None:
    """Write a failed step as a safetensors file, with the plain values in its header.

    Raises:
        ResourceError: The file cannot be written.
    """
    write_bytes(path, *safetensors_chunks(bundle[0], {"step": json.dumps(bundle[1])}))


def read_failed_step(path: Path, device: torch.device) -> Bundle:
    """Read a file of `save_failed_step`; tensors, of shape [...], are on ``device``.

    Raises:
        DataError: The file is missing or not a failed step.
    """
    from safetensors import SafetensorError, safe_open

    try:
        open_input(path).close()
        with safe_open(path, framework="pt", device=str(device)) as f:
            return {n: f.get_tensor(n) for n in f.keys()}, json.loads((f.metadata() or {})["step"])
    except OSError as e:
        raise DataError(f"{path}: cannot be read ({unread_reason(e)}); give the {FILE} of a run folder") from e
    except (SafetensorError, KeyError, ValueError, RecursionError) as e:
        raise DataError(f"{path}: not the inputs of a failed step ({e}); give the {FILE} of a run folder") from e


def _known_terms(config: dict[str, Any]) -> tuple[list[Any], list[str]]:
    """Return the stored loss terms whose classes are loaded, and the names of the others, which are code of the user."""
    names = LOSS_TERMS.names()
    known = [t for t in config["loss_terms"] if (LOSS_TERMS.knows(t["name"]) if ":" in t["name"] else t["name"] in names)]
    return known, [t["name"] for t in config["loss_terms"] if t not in known]


def repeated(bundle: Bundle) -> tuple[StepPlan, Forward]:
    """Repeat the forward pass of a failed step; returns the step's plan, and the results."""
    tensors, plain = bundle
    config = FitConfig.from_json(plain["config"] | {"loss_terms": _known_terms(plain["config"])[0]})
    gaussians = Gaussians(**{n: tensors[f"params.{n}"].requires_grad_() for n in Gaussians.__dataclass_fields__})
    device, K = gaussians.means.device, tensors["K"][None]

    def group(name: str) -> dict[str, torch.Tensor]:
        return {n.removeprefix(f"{name}."): t for n, t in tensors.items() if n.startswith(f"{name}.")}

    number = torch.tensor(plain["number"], dtype=torch.int64, device=device)
    mask, alpha = (None if n not in tensors else tensors[n][None] for n in ("mask", "alpha"))
    distortions = tensors["distortion"][None] if "distortion" in tensors else K.new_empty(1, 0)
    views = ViewStack(
        tensors["viewmat"][None], K, distortions, plain["camera_model"], tensors["image"][None], mask,
        {n: t[None] for n, t in group("maps").items()}, number[None], alpha,
    )  # fmt: skip
    given = {n: f"maps.given_{n}" in tensors for n in ("depth", "normals")}
    terms = tuple(t for t in terms_of(config, plain["cutout"], **given) if t.active(plain["step"], config.steps))
    options = RasterizeOptions(rule=config.rule, background=tensors["background"], antialiased=config.antialiased)
    buffers, render = StepBuffers(device, 1, 1), eager_renderer(options, None)
    buffers.load([0], [[0.0]], [tuple(plain["settings"])])
    plan = StepPlan(plain["degree"], False, terms, None)
    own = [group(f"views.{m.name}") for m in config.view_modules]
    learned = LearnedViews(config.view_modules, own, device, max((len(t) for o in own for t in o.values()), default=0))
    return plan, forward(gaussians, learned, plain["dropout_seed"], views, buffers, plan, render)


def broken_terms(bundle: Bundle) -> list[str]:
    """Compute a failed step again; returns the names of the loaded loss terms with a non-finite value."""
    plan, found = repeated(bundle)
    values = term_values(plan.terms, found.inputs)
    return [t.name for t, v in zip(plan.terms, values, strict=True) if not bool(torch.isfinite(v.detach()).all())]


def findings(bundle: Bundle) -> list[str]:
    """Compute a failed step again; returns a line for every input and result, with its range or its non-finite values.

    User-defined loss terms are computed if their classes are loaded; otherwise a line names them. The strategy's loss terms are
    not computed.

    Raises:
        DataError: A tensor or a value is missing or has the wrong shape.
    """
    tensors, plain = bundle
    try:
        plan, found = repeated(bundle)
        inputs = found.inputs
        size, params = f"{inputs.camera.width} x {inputs.camera.height} px", inputs.gaussians.tensors()
        lines = [f"step {plain['step']} on {plain['view']}, {size}, {len(inputs.gaussians):,} Gaussians"]
        lines += [f"  {name}: {_state(t)}" for name, t in tensors.items()]
        lines += [f"  rendered {name}: {_state(t)}" for name, t in inputs.outputs.items()]
        for term, value in zip(plan.terms, term_values(plan.terms, inputs), strict=True):
            lines.append(f"  loss term {term.name}: {float(value.detach()):g}")
            if not value.requires_grad:  # of the view's own parameters alone
                continue
            of = torch.autograd.grad(value, list(params.values()), retain_graph=True, allow_unused=True)
            broken = [n for n, g in zip(params, of) if g is not None and not bool(torch.isfinite(g).all())]
            lines += [f"    gradient with respect to {n}: not finite" for n in broken]
        lines += [f"  view module {n}: {float(t.detach()):g}" for n, t in found.of_views.items()]
        of_user = "not computed, because it is your own code, which this command does not load"
        lines += [f"  loss term {n}: {of_user}" for n in _known_terms(plain["config"])[1]]
    except (KeyError, IndexError, TypeError, ValueError, RuntimeError) as e:
        raise DataError(f"the stored step is incomplete ({e!r}); fit again to store it again") from e
    return lines


def _state(values: torch.Tensor) -> str:
    """Describe values: their range, or the number of non-finite ones."""
    values = values.detach()
    if not values.numel():
        return "empty"
    bad = int((~torch.isfinite(values)).sum()) if values.is_floating_point() else 0
    if bad:
        return f"{bad:,} of {values.numel():,} NOT FINITE"
    return f"{float(values.min()):g} to {float(values.max()):g}"
