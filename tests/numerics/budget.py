"""The error budget: its lines, the split of an error by cause, and pixels at thresholds that it leaves out."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import torch

from tests.numerics.scenes import SCENES, Scene
from tests.reference.low_precision import Frame, Images, Inputs, ProjectedGaussians, layers, p32, parts, projected_of, r64, r64c
from tests.tolerances import GRADIENT_ULPS, IMAGE_ULPS, LAYER_ULPS, ORDINARY, RATIO, STRESS, ParameterBounds
from warpgs.constants import Rule
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, Gaussians

EPS = 2.0**-23
"""Spacing of float32 at 1."""


@dataclasses.dataclass(frozen=True)
class Band:
    """Pixels near a threshold, and by how much the picture may jump there."""

    reasons: dict[str, torch.Tensor]
    """Mask [H, W] by threshold: alpha cut, stop, clamp, near, equal depth, square."""
    jump: torch.Tensor
    """Largest change of colour or alpha that the decisions in question can make, [H, W]."""
    layers: int
    """Most Gaussians that a pixel blends."""
    largest_color: float
    """Largest colour of any Gaussian or of the background, at least 1."""
    largest_depth: float
    """Largest depth of any Gaussian [u]."""

    @property
    def mask(self) -> torch.Tensor:
        """Pixels in any band [H, W]."""
        return torch.stack(list(self.reasons.values())).any(0)


def ulp(value: float) -> float:
    """Spacing of float32 at a value."""
    x = torch.tensor(value, dtype=torch.float32)
    return float(torch.nextafter(x, torch.tensor(float("inf"))) - x)


def uncertainties(inputs: Inputs, projected: ProjectedGaussians, frame: Frame) -> tuple[torch.Tensor, torch.Tensor]:
    """How far rounding may move each projected mean [px] and each depth [u]: two tensors [N]."""
    reach = inputs.means[projected.ids].norm(dim=1) + inputs.viewmat[:3, 3].norm()
    depth = 2 * EPS * reach
    focal = torch.maximum(inputs.K[0, 0], inputs.K[1, 1])
    size = max(frame.width, frame.height)
    pixel = 2**0.5 * (1.5 * ulp(size) + depth * (focal + size) / projected.depths)
    return pixel, depth


@torch.no_grad()
def band(inputs: Inputs, frame: Frame, rule: Rule, tile_size: int = 16) -> Band:
    """Bands of the float64 picture of a rule."""
    projected = projected_of(inputs, frame, rule)
    width, height = frame.window[2:]
    count = len(projected.ids)
    names = ("cut", "stop", "clamp", "near", "order", "square")
    if count == 0:
        nothing = torch.zeros(height, width)
        return Band({n: nothing.bool() for n in names}, nothing.double(), 0, 1.0, 1.0)
    pixel, depth = uncertainties(inputs, projected, frame)
    # an axis of s1 px turned by a rounded rotation moves its end across the other axis
    short, long = projected.sigmas.clamp_min(rule.low_pass**0.5).unbind(1)
    largest = float(torch.cat([projected.colors.flatten(), inputs.background, torch.ones(1).double()]).max())
    lags = 1
    while lags < count and bool((projected.depths[lags:] - projected.depths[:-lags] <= 2 * depth[lags:]).any()):
        lags += 1
    at_near = bool(
        ((inputs.means @ inputs.viewmat[2, :3] + inputs.viewmat[2, 3] - rule.near).abs() <= float(depth.max())).any()
    )

    flags, jumps, most = {n: [] for n in names}, [], 0
    wider = dataclasses.replace(rule, square_sigma=rule.square_sigma * (1 + 64 * EPS))
    narrower = dataclasses.replace(rule, square_sigma=rule.square_sigma * (1 - 64 * EPS))
    spans = zip(*(parts(projected, frame, r, tile_size) for r in (rule, wider, narrower)))
    for (pixels, reach), (_, wide), (_, narrow) in spans:
        f = layers(pixels, reach, projected, rule)
        most = max(most, int(f.blended.sum(0).max()))
        r = f.power.clamp_min(0).sqrt()
        u = 64 * EPS + r * (pixel[:, None] + 8 * EPS * r * long[:, None]) / short[:, None]
        running = f.before >= rule.transmittance_stop * (1 - 1e-3)
        reached = torch.ones_like(running) if wide is None else wide
        cut = running & reached & (torch.log(f.raw / rule.alpha_cut).abs() <= u)
        above = torch.log(f.raw / rule.alpha_max)
        clamped = above > u
        clamp = running & f.drawn & (above.abs() <= u)
        # relative error of transmittance: those of 1 - alpha add up
        alpha = torch.where(f.drawn, f.alpha, 0)
        each = torch.where(clamped, 0, u) * alpha / (1 - alpha).clamp_min(1 - rule.alpha_max) + 4 * EPS / (1 - alpha)
        drift = torch.cumsum(torch.where(f.drawn, each, 0), 0)
        if rule.inclusive_stop:
            tested, drift = f.before, torch.cat([torch.zeros_like(drift[:1]), drift[:-1]])
        else:
            tested = f.before * (1 - alpha)
        stop = f.drawn & ((tested - rule.transmittance_stop).abs() <= drift * rule.transmittance_stop)
        order, swapped = torch.zeros_like(cut), torch.zeros_like(r)
        for lag in range(1, lags):
            close = (projected.depths[lag:] - projected.depths[:-lag] <= 2 * depth[lag:])[:, None]
            both = close & running[:-lag] & f.drawn[:-lag] & f.drawn[lag:]
            order[:-lag] |= both
            swapped[:-lag] += torch.where(both, f.before[:-lag] * alpha[:-lag] * alpha[lag:], 0)
        square = torch.zeros_like(cut) if wide is None else running & (wide != narrow) & (f.alpha >= rule.alpha_cut)
        found = {"cut": cut, "stop": stop, "clamp": clamp, "order": order, "square": square}
        for name, where in found.items():
            flags[name].append(where.any(0))
        flags["near"].append(torch.full_like(cut[0], at_near))
        # a Gaussian more or less changes the pixel by its weight; a stop, by all that it lets through
        jump = torch.where(cut | square, f.before * f.alpha, 0) + torch.where(stop, f.before, 0) + swapped
        jumps.append(largest * (jump.sum(0) + float(at_near)))
    shape = (height, width)
    reasons = {n: torch.cat(v).view(shape) for n, v in flags.items()}
    return Band(reasons, torch.cat(jumps).view(shape), most, largest, float(projected.depths.max()))


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


SLOPE = {"rgb": 0.5**0.5 * math.exp(-0.5), "alpha": 0.5**0.5 * math.exp(-0.5), "depth": 0.5 * 0.5**0.5 * 3.33}
"""What half an ulp in both coordinates of a mean does to a picture, per ulp and per 1/sigma; c in docs/numerics.md."""


CASES = [("exact", name) for name in SCENES] + [("gsplat-1.5", "wall"), ("inria", "wall"), ("inria", "blobs")]
"""Rules and scenes that the budget is held on: the default rule on all, the others where they differ from it."""


def tile_size_of(rule: str) -> int:
    """Under `inria` the picture depends on the tiles, and smaller ones cut more off."""
    return 8 if rule == "inria" else 16


def limits_of(scene: Scene) -> ParameterBounds:
    """The row of the table for a scene."""
    return STRESS if scene.stress else ORDINARY


def largest_allowed(scene: Scene, rule: Rule, s: Split, name: str) -> float:
    """Largest E of one pixel of a picture."""
    limits = limits_of(scene)
    if scene.stress:
        return limits.image_max
    colors = s.band.largest_color if name == "rgb" else 1.0
    stored = SLOPE[name] * colors * ulp(max(scene.camera.width, scene.camera.height)) / rule.low_pass**0.5
    return limits.image_max + stored


def measure(scene: Scene, rule: Rule, s: Split) -> dict:
    """All figures of a split, as JSON can hold them."""
    images = {n: image_errors(s, n) | {"allowed": largest_allowed(scene, rule, s, n)} for n in IMAGES}
    gradients = {n: gradient_errors(s, n) for n in GRADIENTS}
    inside = s.band.mask
    error = (s.kernel.images["rgb"] - s.truth.images["rgb"]).abs().amax(-1)
    flipped = error[inside] > images["rgb"]["allowed"]
    excess = error[inside] - s.band.jump[inside] - images["rgb"]["allowed"]
    return {
        "scene": scene.name, "rule": rule.name, "device": s.device, "stress": scene.stress, "gaussians": len(scene.gaussians),
        "pixels": inside.numel(), "layers": s.band.layers,
        "band": {name: int(where.sum()) for name, where in s.band.reasons.items()}, "in band": int(inside.sum()),
        "flips": int(flipped.sum()), "beyond jump": int((excess > 0).sum()),
        "pictures": images, "gradients": gradients,
    }  # fmt: skip


def broken(scene: Scene, found: dict) -> list[str]:
    """Every line that is not kept, with what was found and what was allowed."""
    limits, lines = limits_of(scene), []

    def line(what: str, value: float, allowed: float) -> None:
        if not value <= allowed:  # a NaN fails
            lines.append(f"{found['scene']}, {found['rule']}: {what} is {value:.2e}, allowed {allowed:.2e}")

    for name, e in found["pictures"].items():
        line(f"mean E of {name}", e["E mean"], limits.image_mean)
        line(f"max E of {name}", e["E max"], e["allowed"])
        for kind in ("mean", "max"):
            floor = IMAGE_ULPS * EPS * e[f"scale {kind}"]
            line(f"{kind} E of {name} beside P32", e[f"E {kind}"], RATIO * e[f"P32 {kind}"] + floor)
    ulps = GRADIENT_ULPS + LAYER_ULPS[found["device"]] * found["layers"] ** 0.5
    for name, e in found["gradients"].items():
        for kind in ("mean", "max"):
            floor = ulps * EPS * e[f"scale {kind}"]
            line(f"{kind} E of v_{name} beside P32", e[f"E {kind}"], RATIO * e[f"P32 {kind}"] + floor)
        line(f"relative L2 of v_{name}", e["rel L2"], limits.relative_l2)
        line(f"1 - cosine of v_{name}", e["1 - cosine"], limits.cosine)
        line(f"bias of v_{name}", e["bias"], limits.bias)
        line(f"wrong zeros of v_{name}", e["wrong zeros"], 0)
    line("share of pixels in a band", found["in band"] / found["pixels"], limits.band)
    line("flips in the band", found["flips"], limits.flips)
    line("pixels that jump further than a decision can make them", found["beyond jump"], 0)
    return lines
