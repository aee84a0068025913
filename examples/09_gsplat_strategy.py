"""A density strategy of gsplat on our rasterizer: `render` is the whole adapter.

    pip install gsplat
    python examples/09_gsplat_strategy.py --strategy DefaultStrategy --out fitted.png

Fits an image of coloured rings, and prints the PSNR before and after and the number of Gaussians. `MCMCStrategy` calls CUDA
kernels of gsplat, so it needs a GPU and a CUDA toolkit; `DefaultStrategy` runs on a CPU, too.
"""

import argparse
import importlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import warpgs

import torch
from PIL import Image

LRS = {"means": 5e-3, "quats": 5e-3, "scales": 2e-2, "opacities": 5e-2, "sh0": 2e-2, "shN": 1e-3}
OPTIONS: dict[str, dict[str, Any]] = {
    "DefaultStrategy": {"refine_start_iter": 20, "refine_every": 20, "absgrad": True, "grow_grad2d": 1e-3},
    "MCMCStrategy": {"refine_start_iter": 20, "refine_every": 20, "cap_max": 1000},
}


def render(
    params: Mapping[str, torch.Tensor], camera: warpgs.Camera, options: warpgs.RasterizeOptions
) -> tuple[warpgs.Render, dict[str, Any]]:
    """Render parameters under gsplat's names; return the render, and the ``info`` that gsplat's strategies read."""
    sh = torch.cat([params["sh0"], params["shN"]], 1)
    gaussians = warpgs.Gaussians(params["means"], params["quats"], params["scales"], params["opacities"], sh)
    found = warpgs.rasterize(gaussians, camera, options)
    info = {
        "means2d": found.means2d,
        "radii": found.projected.detach()[..., 10:12].ceil(),  # half sides of the bounding boxes [px], 0 where culled
        "gaussian_ids": None,  # only read in packed mode
        "width": camera.width,
        "height": camera.height,
        "n_cameras": len(found.projected),
    }
    return found, info


def initial_parameters(count: int) -> dict[str, torch.nn.Parameter]:
    """Return grey Gaussians on a plane one unit in front of the camera, under gsplat's names."""
    xy = torch.rand(count, 2, generator=torch.Generator().manual_seed(0)) - 0.5
    tensors = {
        "means": torch.cat([xy, torch.ones(count, 1)], 1),
        "quats": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        "scales": torch.full((count, 3), 0.5 / count**0.5).log(),
        "opacities": torch.zeros(count),
        "sh0": torch.zeros(count, 1, 3),
        "shN": torch.zeros(count, 3, 3),
    }
    device = "cuda" if torch.cuda.is_available() else "cpu"
    return {name: torch.nn.Parameter(t.to(device)) for name, t in tensors.items()}


def main(arguments: list[str] | None = None) -> float:
    """Run the example; return the gain in PSNR [dB]."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--strategy", choices=OPTIONS, default="DefaultStrategy", help="class of gsplat")
    parser.add_argument("--out", type=Path, default=Path("fitted.png"), help="PNG to write")
    parser.add_argument("--steps", type=int, default=200, help="optimisation steps")
    parser.add_argument("--count", type=int, default=200, help="number of Gaussians at the start")
    parser.add_argument("--size", type=int, default=64, help="side of the image [px]")
    a = parser.parse_args(arguments)

    params = initial_parameters(a.count)
    optimizers = {name: torch.optim.Adam([p], lr=LRS[name]) for name, p in params.items()}
    axis = torch.linspace(-1, 1, a.size, device=params["means"].device)
    phases = torch.tensor([0.0, 2.0, 4.0], device=axis.device)
    target = 0.5 + 0.5 * torch.cos(12 * torch.hypot(axis[None, :], axis[:, None])[..., None] + phases)
    K = torch.tensor([[a.size, 0, a.size / 2], [0, a.size, a.size / 2], [0, 0, 1.0]])
    camera = warpgs.Camera(torch.eye(4), K, a.size, a.size)

    strategy = getattr(importlib.import_module("gsplat"), a.strategy)(**OPTIONS[a.strategy])
    default = a.strategy == "DefaultStrategy"
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state(scene_scale=1.0) if default else strategy.initialize_state()
    extra = {"packed": False} if default else {"lr": LRS["means"]}
    options = warpgs.RasterizeOptions(absgrad=default)
    errors = []
    for step in range(a.steps):
        found, info = render(params, camera, options)
        errors.append(float((found.rgb.detach().clamp(0, 1) - target).square().mean()))
        strategy.step_pre_backward(params, optimizers, state, step, info)
        (found.rgb - target).abs().mean().backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad()
        strategy.step_post_backward(params, optimizers, state, step, info, **extra)

    Image.fromarray((found.rgb.detach().clamp(0, 1) * 255).round().byte().cpu().numpy()).save(a.out)
    first, last = (float(-10 * torch.tensor(e).log10()) for e in (errors[0], errors[-1]))
    print(
        f"{a.count} -> {len(params['means'])} Gaussians, {a.steps} steps: PSNR {first:.1f} -> {last:.1f} dB; image in {a.out}"
    )
    return last - first


if __name__ == "__main__":
    main()
