"""Which lines of the error budget a split breaks; the limits stand in tests/tolerances.py, the reasons in docs/numerics.md."""

from __future__ import annotations

import math

from tests.numerics.scenes import SCENES, Scene
from tests.numerics.split import GRADIENTS, IMAGES, Split, gradient_errors, image_errors
from tests.numerics.thresholds import EPS, ulp
from tests.tolerances import GRADIENT_ULPS, IMAGE_ULPS, LAYER_ULPS, ORDINARY, RATIO, STRESS, ParameterBounds
from warpgs.constants import Rule

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
