"""Gaussians with 16 features each instead of a colour, fitted to an image of features, such as the output of a network.

    python examples/08_feature_field.py --out features.png

Prints the cosine similarity of the features before and after; writes the three principal components of target and result as
colours.
"""

import argparse
from pathlib import Path

import warpgs

import torch
from PIL import Image

CHANNELS = 16


def feature_image(size: int) -> torch.Tensor:
    """Return waves of many directions and wavelengths, as unit vectors at each pixel, shape [size, size, CHANNELS]."""
    generator = torch.Generator().manual_seed(1)
    y, x = torch.meshgrid(torch.linspace(-1, 1, size), torch.linspace(-1, 1, size), indexing="ij")
    frequencies, phases = 8 * torch.randn(2, CHANNELS, generator=generator), 6.28 * torch.rand(CHANNELS, generator=generator)
    waves = torch.cos(x[..., None] * frequencies[0] + y[..., None] * frequencies[1] + phases)
    return torch.nn.functional.normalize(waves, dim=-1)


def random_gaussians(count: int) -> warpgs.Gaussians:
    """Return Gaussians on a plane one unit in front of the camera; their spherical harmonics are never read."""
    xy = torch.rand(count, 2, generator=torch.Generator().manual_seed(0)) - 0.5
    return warpgs.Gaussians(
        means=torch.cat([xy, torch.ones(count, 1)], 1).requires_grad_(),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1).requires_grad_(),
        log_scales=torch.full((count, 3), -0.5 - 0.5 * float(torch.log(torch.tensor(count)))).requires_grad_(),
        logit_opacities=torch.zeros(count).requires_grad_(),
        sh=torch.zeros(count, 1, 3),
    )


def main(arguments: list[str] | None = None) -> float:
    """Run the example; return the gain in cosine similarity."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("features.png"), help="PNG to write")
    parser.add_argument("--steps", type=int, default=200, help="optimisation steps")
    parser.add_argument("--count", type=int, default=800, help="number of Gaussians")
    parser.add_argument("--size", type=int, default=96, help="side of the image [px]")
    a = parser.parse_args(arguments)

    target = feature_image(a.size)
    K = torch.tensor([[a.size, 0, a.size / 2], [0, a.size, a.size / 2], [0, 0, 1.0]])
    camera = warpgs.Camera(torch.eye(4), K, a.size, a.size)
    gaussians = random_gaussians(a.count)
    features = (0.1 * torch.randn(a.count, CHANNELS, generator=torch.Generator().manual_seed(2))).requires_grad_()

    def rendered() -> torch.Tensor:
        return warpgs.rasterize(gaussians, camera, warpgs.RasterizeOptions(colors=features)).rgb

    def similarity() -> float:
        return float(torch.cosine_similarity(rendered().detach(), target, dim=-1).mean())

    optimizer = torch.optim.Adam([*list(gaussians.tensors().values())[:4], features], lr=0.02)
    first = similarity()
    for _ in range(a.steps):
        optimizer.zero_grad()
        loss = (rendered() - target).square().sum(-1).mean()
        loss.backward()
        optimizer.step()

    last = similarity()
    flat = target.reshape(-1, CHANNELS)
    directions = torch.linalg.eigh(flat.T @ flat).eigenvectors[:, -3:]
    both = torch.cat([target, rendered().detach()], 1) @ directions
    Image.fromarray((both * 127 + 128).clamp(0, 255).byte().numpy()).save(a.out)
    print(f"{a.count} Gaussians, {a.steps} steps: cosine similarity {first:.3f} -> {last:.3f}; target and result in {a.out}")
    return last - first


if __name__ == "__main__":
    main()
