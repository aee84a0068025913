"""The error of the kernels split in two: arithmetic E = |kernel - R64c| and approximation A = |R64c - R64|.

Gradients are those of one random mix of colour, alpha and depth, with nothing asked of pixels in a band: there a Gaussian
may rightly be drawn in one program and not in the other, so everything else can be compared without exemptions.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from tests.numerics.scenes import Scene
from tests.numerics.thresholds import Band, band
from tests.reference.low_precision import Images, Inputs, p32, r64, r64c
from warpgs.constants import Rule
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, Gaussians

IMAGES = Images._fields
GRADIENTS = Inputs._fields


@dataclass(frozen=True)
class SampledView:
    """Pictures and gradients of one program by name, float64 on the CPU; depth over the scene's largest."""

    images: dict[str, torch.Tensor]
    gradients: dict[str, torch.Tensor]


@dataclass(frozen=True)
class Split:
    """What the kernels drew, the twins beside it, and where decisions are open."""

    kernel: SampledView
    truth: SampledView
    """R64c."""
    plain: SampledView
    """P32."""
    model: SampledView | None
    """R64, where asked for."""
    band: Band
    device: str
    """Where the kernels ran: cpu or cuda."""


def _kernel(inputs: Inputs, scene: Scene, rule: Rule, tile_size: int) -> Images:
    options = RasterizeOptions(rule=rule, background=inputs.background, tile_size=tile_size, window=scene.window)
    camera = Camera(inputs.viewmat, inputs.K, scene.camera.width, scene.camera.height)
    r = rasterize(Gaussians(*inputs[:5]), camera, options)
    return Images(r.rgb, r.alpha, r.depth)


def _drawn(inputs: Inputs, images: Images, upstream: Images, largest_depth: float) -> SampledView:
    loss = sum((p * u.to(p)).sum() for p, u in zip(images, upstream))
    gradients = torch.autograd.grad(loss, list(inputs), allow_unused=True)
    plain = [torch.zeros_like(t) if g is None else g for g, t in zip(gradients, inputs)]
    named = {n: p.detach().cpu().double() for n, p in zip(IMAGES, images)}
    return SampledView(
        named | {"depth": named["depth"] / largest_depth}, {n: g.cpu().double() for n, g in zip(GRADIENTS, plain)}
    )


def upstream_of(truth: Images, near: torch.Tensor) -> Images:
    """Random gradients of the pictures, 0 in the band; those of depth smaller, as depths are larger than colours."""
    generator = torch.Generator().manual_seed(11)
    weights = [torch.randn(p.shape, generator=generator, dtype=torch.float64) for p in truth]
    open_to_view = (~near).double()
    return Images(weights[0] * open_to_view[..., None], weights[1] * open_to_view, 0.2 * weights[2] * open_to_view)


def split(
    scene: Scene, rule: Rule, device: torch.device | str = "cpu", tile_size: int = 16, with_model: bool = False
) -> Split:  # fmt: skip
    """Draw a scene by the kernels and by the twins; ``with_model`` by R64 too, which takes longest."""
    stored, frame = scene.inputs(), scene.frame()
    exact, single = stored.to(torch.float64), stored.to(torch.float32)
    there = Inputs(*(t.detach().to(device).requires_grad_() for t in single))
    near = band(exact, frame, rule, tile_size)
    truth = r64c(exact, frame, rule, tile_size)
    how = (upstream_of(truth, near.mask), near.largest_depth)
    return Split(
        _drawn(there, _kernel(there, scene, rule, tile_size), *how),
        _drawn(exact, truth, *how),
        _drawn(single, p32(single, frame, rule, tile_size), *how),
        _drawn(exact, r64(exact, frame, rule), *how) if with_model else None,
        near,
        torch.device(device).type,
    )


def image_errors(s: Split, name: str) -> dict[str, float]:
    """Largest and mean E of the kernels and of P32 outside the bands, their floor, and A everywhere."""
    outside = ~s.band.mask
    truth = s.truth.images[name]
    found = {"scale max": float(truth.abs().max()), "scale mean": float(truth.abs().mean())}
    for label, drawn in (("E", s.kernel), ("P32", s.plain)):
        error = (drawn.images[name] - truth).abs()[outside]
        found |= {f"{label} max": float(error.max()), f"{label} mean": float(error.mean())}
    if s.model:
        a = (truth - s.model.images[name]).abs()
        found |= {"A max": float(a.max()), "A mean": float(a.mean())}
    return found


def gradient_errors(s: Split, name: str) -> dict[str, float]:
    """E and P32's over the largest gradient, relative L2, 1 - cosine, signed bias, and zeros that are none or should be."""
    truth = s.truth.gradients[name]
    scale = float(truth.abs().max()) or 1.0
    t, k = truth / scale, s.kernel.gradients[name] / scale
    found = {"scale max": float(t.abs().max()), "scale mean": float(t.abs().mean())}
    for label, drawn in (("E", k), ("P32", s.plain.gradients[name] / scale)):
        found |= {f"{label} max": float((drawn - t).abs().max()), f"{label} mean": float((drawn - t).abs().mean())}
    # 1 - cosine from the part of k across t: 1 - cos itself would lose its digits
    norm = float(t.norm()) or 1.0
    across = k - t * (float((k * t).sum()) / norm**2)
    sine = min(1.0, float(across.norm()) / (float(k.norm()) or 1.0))
    found |= {
        "rel L2": float((k - t).norm()) / norm,
        "1 - cosine": sine**2 / (1 + (1 - sine**2) ** 0.5) if float((k * t).sum()) >= 0 else 2.0,
        "bias": abs(float((k - t).mean())) / (float(t.abs().mean()) or 1.0),
        "wrong zeros": int((((t == 0) & (k != 0)) | ((t.abs() > 1e-12) & (k == 0))).sum()),
    }
    if s.model:
        other = s.model.gradients[name]
        a, largest = (truth - other).abs(), max(float(truth.abs().max()), float(other.abs().max())) or 1.0
        found |= {"A max": float(a.max()) / largest, "A mean": float(a.mean()) / largest}
    return found
