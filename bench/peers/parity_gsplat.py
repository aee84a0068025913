"""Images and gradients of rule `gsplat-1.5` against those of gsplat, on the garden cloud, on a CUDA device.

Needs gsplat 1.5.3 (`pip install gsplat==1.5.3`, which builds itself on first use).
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch

from bench.lib import result_file
from bench.lib.arguments import parse
from bench.lib.inputs import garden_inputs
from bench.lib.peers import gsplat_rasterize
from warpgs import RasterizeOptions, rasterize

LIMITS = {"image_mean": 1e-5, "image_fraction_below_1e-4": 0.9999, "rel_l2": 1e-3, "cosine": 0.9999, "norm_ratio": 1e-3}


def compare(path: Path, degree: int, width: int, height: int) -> dict:
    """Differences of one configuration: the image's, and per parameter those of the gradient of a random projection."""
    gaussians, camera = garden_inputs(path, sh_degree=degree, width=width, height=height)
    images, gradients = [], []
    for draw in (
        lambda: rasterize(gaussians, camera, RasterizeOptions(rule="gsplat-1.5")).rgb,
        lambda: gsplat_rasterize(gaussians, camera),
    ):
        image = draw()
        generator = torch.Generator(device=image.device).manual_seed(1)
        weights = torch.rand(image.shape, generator=generator, device=image.device)
        gradients.append(torch.autograd.grad((image * weights).sum(), list(gaussians.tensors().values())))
        images.append(image.detach())
    difference = (images[0] - images[1]).abs()
    row = {
        "sh_degree": degree, "width": width, "height": height, "gaussians": len(gaussians),
        "image_mean": difference.mean().item(), "image_max": difference.max().item(),
        "image_fraction_below_1e-4": (difference.amax(-1) < 1e-4).double().mean().item(), "gradients": {},
    }  # fmt: skip
    for name, a, b in zip(gaussians.tensors(), *gradients):
        a, b = a.double().flatten(), b.double().flatten()
        row["gradients"][name] = {
            "rel_l2": ((a - b).norm() / b.norm()).item(),
            "cosine": (a @ b / (a.norm() * b.norm())).item(),
            "norm_ratio": (a.norm() / b.norm()).item(),
        }
    return row


def passes(row: dict) -> bool:
    """Return whether every figure of a row keeps its limit."""
    gradients = row["gradients"].values()
    return (
        row["image_mean"] < LIMITS["image_mean"]
        and row["image_fraction_below_1e-4"] >= LIMITS["image_fraction_below_1e-4"]
        and all(g["rel_l2"] < LIMITS["rel_l2"] and g["cosine"] > LIMITS["cosine"] for g in gradients)
        and all(abs(g["norm_ratio"] - 1) < LIMITS["norm_ratio"] for g in gradients)
    )


def main() -> int:
    """Print a line per configuration; exit 1 if any misses a limit."""
    a = parse(__doc__, None, {"garden": Path}, out=Path)
    rows = [compare(a.garden, d, w, h) for d in (0, 3) for w, h in ((648, 420), (1920, 1080))]
    for row in rows:
        worst = {k: max(g[k] for g in row["gradients"].values()) for k in ("rel_l2",)}
        worst["cosine"] = min(g["cosine"] for g in row["gradients"].values())
        worst["norm_ratio"] = max(abs(g["norm_ratio"] - 1) for g in row["gradients"].values())
        print(
            f"SH {row['sh_degree']} {row['width']}x{row['height']}: image mean {row['image_mean']:.1e}, "
            f"{100 * row['image_fraction_below_1e-4']:.4f} % of pixels below 1e-4, max {row['image_max']:.1e}; gradients: "
            f"rel-L2 {worst['rel_l2']:.1e}, cosine {worst['cosine']:.8f}, norm off by {worst['norm_ratio']:.1e}; "
            f"{'pass' if passes(row) else 'FAIL'}"
        )
    what = "images and gradients of rule gsplat-1.5 against gsplat on the garden cloud"
    result_file.keep(a.out, what, torch.device("cuda"), rows)
    return 0 if all(passes(r) for r in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
