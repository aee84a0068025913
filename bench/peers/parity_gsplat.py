"""Images and gradients of rule `gsplat-1.6` against those of gsplat 1.6.0, on the garden cloud, on a CUDA device.

Spherical harmonics of degree 0 and 3, 32 plain channels, antialiased opacities, an orthographic and a fisheye camera. Two
definitions differ: gsplat's antialiasing factor is at least 0.005, and its fisheye orders Gaussians by z, ours by distance.
Needs gsplat 1.6.0, built from its repository.
"""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass, field
from pathlib import Path

import torch

from bench.lib import rasterizers, result_file
from bench.lib.arguments import parse
from bench.lib.inputs import first_camera, garden_inputs
from warpgs.scene import Camera

LIMITS = {"image_mean": 1e-5, "image_fraction_below_1e-4": 0.9999, "rel_l2": 1e-3, "cosine": 0.9999, "norm_ratio": 1e-3}
RULE = "gsplat-1.6"
UNITS_WIDE = 8.0
"""Width of the view of the orthographic camera [u]."""


@dataclass(frozen=True)
class Case:
    """One way to render, with our arguments and gsplat's."""

    name: str
    degree: int = 3
    channels: int = 0
    """Plain channels in place of spherical harmonics; 0 for none."""
    model: str = "pinhole"
    ours: dict = field(default_factory=dict)
    gsplat: dict = field(default_factory=dict)
    differs: str = ""
    """Definition in which both programs differ; such a case need not keep the limits."""


CASES = (
    Case("degree 0", 0),
    Case("degree 3"),
    Case("32 channels", channels=32),
    Case(
        "antialiased",
        ours={"antialiased": True},
        gsplat={"rasterize_mode": "antialiased"},
        differs="gsplat's factor is at least 0.005",
    ),
    Case("orthographic", model="orthographic", gsplat={"camera_model": "ortho"}),
    Case("fisheye", model="fisheye", gsplat={"camera_model": "fisheye"}, differs="gsplat orders by z, we by distance"),
)


def seen_by(camera: Camera, model: str) -> Camera:
    """Return a batch of cameras of a model other than pinhole; the scale of an orthographic camera is in px/u."""
    if model == "orthographic":
        K = camera.K.clone()
        K[:, 0, 0] = K[:, 1, 1] = camera.width / UNITS_WIDE
        return dataclasses.replace(camera, K=K, model=model)
    if model == "fisheye":
        return dataclasses.replace(camera, model=model, distortion=camera.K.new_zeros(len(camera.K), 4))
    return camera


def compare(path: Path, case: Case, width: int, height: int, device: torch.device, peer=rasterizers.gsplat) -> dict:
    """Return the differences of one case: of the image, and by parameter of the gradient of a random projection."""
    g, cameras = garden_inputs(path, sh_degree=case.degree, width=width, height=height, device=device)
    camera = seen_by(first_camera(cameras), case.model)
    generator = torch.Generator().manual_seed(1)
    channels = case.channels or 3
    colors = 2 * torch.rand(len(g), channels, generator=generator).to(device) - 1 if case.channels else None
    weights = torch.rand(height, width, channels, generator=generator).to(device)
    both = rasterizers.ours(g, camera, colors, rule=RULE, **case.ours), peer(g, camera, colors, **case.gsplat)
    with torch.no_grad():
        difference = (both[0].image() - both[1].image()).abs()
    gradients = [drawing.named_gradients(weights) for drawing in both]
    row = {
        "case": case.name, "width": width, "height": height, "gaussians": len(g), "differs": case.differs,
        "image_mean": difference.mean().item(), "image_max": difference.max().item(),
        "image_fraction_below_1e-4": (difference.amax(-1) < 1e-4).double().mean().item(), "gradients": {},
    }  # fmt: skip
    for name, a in gradients[0].items():
        a, b = a.double().flatten(), gradients[1][name].double().flatten()
        row["gradients"][name] = {
            "rel_l2": ((a - b).norm() / b.norm()).item(),
            "cosine": (a @ b / (a.norm() * b.norm())).item(),
            "norm_ratio": (a.norm() / b.norm()).item(),
        }
    return row


def passes(row: dict) -> bool:
    """Return whether every value of a row keeps its limit."""
    gradients = row["gradients"].values()
    return (
        row["image_mean"] < LIMITS["image_mean"]
        and row["image_fraction_below_1e-4"] >= LIMITS["image_fraction_below_1e-4"]
        and all(g["rel_l2"] < LIMITS["rel_l2"] and g["cosine"] > LIMITS["cosine"] for g in gradients)
        and all(abs(g["norm_ratio"] - 1) < LIMITS["norm_ratio"] for g in gradients)
    )


def main() -> int:
    """Print a line per case; exit 1 if one misses a limit without a reason."""
    a = parse(__doc__, None, {"garden": Path}, out=Path, device="cuda", sizes=["648x420", "1920x1080"])
    device = torch.device(a.device)
    sizes = [tuple(map(int, size.split("x"))) for size in a.sizes]
    rows = [compare(a.garden, case, *size, device) for case in CASES for size in sizes]
    for row in rows:
        worst = max(g["rel_l2"] for g in row["gradients"].values())
        cosine = min(g["cosine"] for g in row["gradients"].values())
        verdict = "pass" if passes(row) else f"differs: {row['differs']}" if row["differs"] else "FAIL"
        print(
            f"{row['case']:<13} {row['width']}x{row['height']}: image mean {row['image_mean']:.1e}, "
            f"{100 * row['image_fraction_below_1e-4']:.4f} % of pixels below 1e-4, max {row['image_max']:.1e}; gradients: "
            f"rel-L2 {worst:.1e}, cosine {cosine:.8f}; {verdict}"
        )
    result_file.keep(a.out, f"images and gradients of rule {RULE} against gsplat on the garden cloud", device, rows)
    return 0 if all(passes(r) or r["differs"] for r in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
