"""A trainer written for gsplat on this rasterizer: only its import line changes.

    python examples/13_gsplat_rasterization.py --out fitted.png

Fits an image of coloured rings outside of a mask, and prints the PSNR before and after. Writes the image and its depth.
"""

import argparse
from pathlib import Path

from warpgs.compat.gsplat import rasterization  # before torch; was: from gsplat import rasterization

import torch
from PIL import Image


def main(arguments: list[str] | None = None) -> float:
    """Run the example; return the gain in PSNR [dB]."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("fitted.png"), help="PNG to write")
    parser.add_argument("--steps", type=int, default=100, help="optimisation steps")
    parser.add_argument("--count", type=int, default=300, help="number of Gaussians")
    parser.add_argument("--size", type=int, default=64, help="side of the image [px]")
    a = parser.parse_args(arguments)

    torch.manual_seed(0)
    axis = torch.linspace(-1, 1, a.size)
    radius = torch.hypot(axis[None, :], axis[:, None])[None]
    target = 0.5 + 0.5 * torch.cos(12 * radius[..., None] + torch.tensor([0.0, 2.0, 4.0]))
    mask = radius > 0.3
    means = torch.cat([torch.rand(a.count, 2) - 0.5, torch.ones(a.count, 1)], 1)
    logits, colors = torch.zeros(a.count), torch.full((a.count, 3), 0.5)
    sizes, quats = torch.full((a.count, 3), 0.5 / a.count**0.5).log(), torch.randn(a.count, 4)
    parameters = [t.requires_grad_() for t in (means, quats, sizes, logits, colors)]
    optimizer = torch.optim.Adam(parameters, lr=0.02)
    K = torch.tensor([[a.size, 0, a.size / 2], [0, a.size, a.size / 2], [0, 0, 1.0]])
    scores = []
    for _ in range(a.steps):
        images, _, _ = rasterization(
            means, quats, sizes.exp(), logits.sigmoid(), colors, torch.eye(4)[None], K[None], a.size, a.size,
            render_mode="RGB+ED",
        )  # fmt: skip
        images[~mask] = 0  # as trainers do with their masks
        rgb, depth = images[..., :3], images[..., 3:].detach()
        scores.append(-10 * (rgb - target)[mask].square().mean().log10().item())
        optimizer.zero_grad()
        (rgb - target)[mask].abs().mean().backward()
        optimizer.step()

    row = torch.cat([rgb.detach(), (depth / 2).expand_as(rgb)], 2)[0].clamp(0, 1)
    Image.fromarray((row * 255).round().byte().numpy()).save(a.out)
    print(f"{a.steps} steps: PSNR {scores[0]:.1f} -> {scores[-1]:.1f} dB; images in {a.out}")
    return scores[-1] - scores[0]


if __name__ == "__main__":
    main()
