"""Optimise Gaussians until they look like an image: the rasterizer, a loss and torch's Adam.

    python examples/01_fit_image.py --image image.jpg --out fitted.png

Without --image, a pattern of coloured rings is fitted. Prints the PSNR before and after the fit; writes target and result side
by side.
"""

import argparse
from pathlib import Path

import warpgs

import numpy as np
import torch
from PIL import Image


def rings(size: int) -> torch.Tensor:
    """Return an image of coloured rings, colours in [0, 1], shape [size, size, 3]."""
    y, x = torch.meshgrid(torch.linspace(-1, 1, size), torch.linspace(-1, 1, size), indexing="ij")
    phases = torch.tensor([0.0, 2.0, 4.0])
    return 0.5 + 0.5 * torch.cos(12 * torch.hypot(x, y)[..., None] + phases)


def random_gaussians(count: int, generator: torch.Generator) -> warpgs.Gaussians:
    """Return grey Gaussians on a plane one unit in front of the camera; they require gradients."""
    xy = torch.rand(count, 2, generator=generator) - 0.5
    tensors = {
        "means": torch.cat([xy, torch.ones(count, 1)], 1),
        "quats": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        "log_scales": torch.full((count, 3), -0.5).sub(0.5 * torch.log(torch.tensor(float(count)))),
        "logit_opacities": torch.zeros(count),
        "sh": torch.zeros(count, 1, 3),
    }
    return warpgs.Gaussians(**{name: t.requires_grad_() for name, t in tensors.items()})


def psnr(a: torch.Tensor, b: torch.Tensor) -> float:
    """Return the PSNR of two images in [0, 1] [dB]."""
    return float(-10 * torch.log10((a.detach().clamp(0, 1) - b).square().mean()))


def main(arguments: list[str] | None = None) -> float:
    """Run the example; return the gain in PSNR [dB]."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--image", type=Path, help="image to fit; default: coloured rings")
    parser.add_argument("--out", type=Path, default=Path("fitted.png"), help="PNG to write")
    parser.add_argument("--steps", type=int, default=300, help="optimisation steps")
    parser.add_argument("--count", type=int, default=1000, help="number of Gaussians")
    parser.add_argument("--size", type=int, default=96, help="size of the longer side of the image [px]")
    a = parser.parse_args(arguments)

    if a.image is None:
        target = rings(a.size)
    else:
        image = Image.open(a.image).convert("RGB")
        image.thumbnail((a.size, a.size))
        target = torch.from_numpy(np.asarray(image, np.float32) / 255)
    height, width, _ = target.shape
    side = max(width, height)  # focal length such that the plane of the Gaussians spans the longer side
    K = torch.tensor([[side, 0, width / 2], [0, side, height / 2], [0, 0, 1.0]])
    camera = warpgs.Camera(torch.eye(4), K, width, height)

    gaussians = random_gaussians(a.count, torch.Generator().manual_seed(0))
    optimizer = torch.optim.Adam(list(gaussians.tensors().values()), lr=0.02)
    first = psnr(warpgs.rasterize(gaussians, camera).rgb, target)
    for _ in range(a.steps):
        optimizer.zero_grad()
        loss = (warpgs.rasterize(gaussians, camera).rgb - target).abs().mean()
        loss.backward()
        optimizer.step()

    with torch.no_grad():
        rgb = warpgs.rasterize(gaussians, camera).rgb
    last = psnr(rgb, target)
    both = torch.cat([target, rgb.clamp(0, 1)], 1)
    Image.fromarray((both * 255).round().byte().numpy()).save(a.out)
    print(f"{a.count} Gaussians, {a.steps} steps: PSNR {first:.1f} -> {last:.1f} dB; target and result in {a.out}")
    return last - first


if __name__ == "__main__":
    main()
