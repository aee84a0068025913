"""Three depths and two kinds of normals of a small scene: a ball of flat Gaussians in front of a wall.

    python examples/10_depth_and_normals.py --out depth_and_normals.png

Writes one row of images: expected, accumulated and median depth, normals of the Gaussians, and normals of the expected depth.
Prints, for both kinds of normals, the mean angle between the rendered normals of the ball and the true normals of a sphere.
"""

import argparse
import math
from pathlib import Path

import warpgs

import torch
from PIL import Image

CENTER = torch.tensor([0.0, 0.0, 3.0])
"""Centre of the ball, which has a radius of 1 u."""


def discs(points: torch.Tensor, normals: torch.Tensor, radius: float) -> dict[str, torch.Tensor]:
    """Return the fields of flat Gaussians at points [N, 3], perpendicular to unit normals [N, 3]; each has shape [N, ...]."""
    n = len(points)
    x, y, z = normals.unbind(1)
    return {
        "means": points,
        "quats": torch.stack([1 + z, -y, x, 0 * z], 1),  # turns the z axis to the normal
        "log_scales": torch.tensor([radius, radius, radius / 20]).log().repeat(n, 1),
        "logit_opacities": torch.full((n,), 3.0),
        "sh": torch.zeros(n, 1, 3),
    }


def ball_and_wall(count: int) -> warpgs.Gaussians:
    """Return ``count`` Gaussians on a ball, and 900 on a wall behind it."""
    i = torch.arange(count) + 0.5
    z, angle = 1 - 2 * i / count, math.pi * (1 + 5**0.5) * i  # points of a spiral, evenly spread
    around = torch.stack([(1 - z * z).sqrt() * angle.cos(), (1 - z * z).sqrt() * angle.sin(), z], 1)
    ball = discs(CENTER + around, around, 3 / count**0.5)
    steps = torch.linspace(-3.5, 3.5, 30)
    wall = torch.cartesian_prod(steps, steps, torch.tensor([5.0]))
    behind = discs(wall, torch.tensor([[0.0, 0.0, 1.0]]).expand_as(wall), 0.2)
    return warpgs.Gaussians(**{name: torch.cat([ball[name], behind[name]]) for name in ball})


def main(arguments: list[str] | None = None) -> float:
    """Run the example; return the mean angle between the rendered normals of the Gaussians and those of a sphere [degrees]."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("depth_and_normals.png"), help="PNG to write")
    parser.add_argument("--count", type=int, default=4000, help="number of Gaussians on the ball")
    parser.add_argument("--size", type=int, default=128, help="side of one image [px]")
    a = parser.parse_args(arguments)

    K = torch.tensor([[1.0 * a.size, 0, a.size / 2], [0, 1.0 * a.size, a.size / 2], [0, 0, 1]])
    camera = warpgs.Camera(torch.eye(4), K, a.size, a.size)
    gaussians = ball_and_wall(a.count)
    options = warpgs.RasterizeOptions(features=warpgs.gaussian_normals(gaussians, camera), median_depth=True)
    render = warpgs.rasterize(gaussians, camera, options)
    assert render.features is not None and render.median_depth is not None

    depths = [render.depth, render.depth * render.alpha, render.median_depth]
    normals = [torch.nn.functional.normalize(render.features, dim=-1), warpgs.depth_normals(camera, render.depth)]

    grey = [((5 - d) / 3.5)[..., None].expand(-1, -1, 3) for d in depths]  # white at 1.5 u, black at the wall
    colored = [0.5 + 0.5 * n * torch.tensor([1.0, -1.0, -1.0]) for n in normals]  # blue faces the camera
    row = torch.cat([*grey, *colored], 1).clamp(0, 1)
    Image.fromarray((row * 255).round().byte().numpy()).save(a.out)

    axis = (torch.arange(a.size) + 0.5) / a.size - 0.5
    rays = torch.stack([*torch.meshgrid(axis, axis, indexing="xy"), torch.ones(a.size, a.size)], -1)
    square, along = rays.square().sum(-1), rays @ CENTER  # a ray meets the ball where square t^2 - 2 along t + 8 = 0
    root = (along.square() - 8 * square).clamp_min(0).sqrt()
    sphere = rays * ((along - root) / square)[..., None] - CENTER
    hit = root > 0.4  # root is 1 in the middle of the ball, 0 at its rim
    angles = [torch.rad2deg(torch.arccos((n * sphere).sum(-1).clamp(-1, 1)))[hit].mean().item() for n in normals]
    print(f"normals of the Gaussians {angles[0]:.1f} degrees off the sphere's, of the depth {angles[1]:.1f}; images in {a.out}")
    return angles[0]


if __name__ == "__main__":
    main()
