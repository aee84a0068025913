"""Frozen scenes that the error budget is measured on: ordinary ones and stresses, all float32, made from fixed seeds."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch

from tests.gaussians import camera, cloud
from tests.reference.low_precision import Frame, Inputs
from warpgs.scene import Camera, Gaussians


@dataclass(frozen=True)
class Scene:
    """Gaussians, a camera, a background, and which part of the picture is looked at."""

    name: str
    gaussians: Gaussians
    camera: Camera
    stress: bool = False
    """Whether the stress limits apply instead of the ordinary ones."""
    window: tuple[int, int, int, int] | None = None

    def inputs(self) -> Inputs:
        background = torch.tensor([0.3, 0.7, 0.1])
        return Inputs(*self.gaussians.tensors().values(), self.camera.viewmat, self.camera.K, background)

    def frame(self) -> Frame:
        width, height = self.camera.width, self.camera.height
        return Frame(width, height, self.gaussians.sh_degree, self.window or (0, 0, width, height))


def _camera(width: int, height: int) -> Camera:
    return camera(width, height, dtype=torch.float32)


def _rand(seed: int):
    generator = torch.Generator().manual_seed(seed)
    return lambda *shape: torch.rand(*shape, generator=generator, dtype=torch.float64)


def _gaussians(means, quats, log_scales, logit_opacities, sh) -> Gaussians:
    return Gaussians(*(t.float() for t in (means, quats, log_scales, logit_opacities, sh)))


def _at(pixels: torch.Tensor, depths: torch.Tensor, cam: Camera) -> torch.Tensor:
    """World positions of pixels [N, 2] at depths [N] for a camera at the origin."""
    K = cam.K.double()
    xy = (pixels - K[:2, 2]) / torch.stack([K[0, 0], K[1, 1]])
    return torch.cat([xy * depths[:, None], depths[:, None]], 1)


def random_cloud() -> Scene:
    """Gaussians of 1 to 5 px in random places, colours of degree 3."""
    return Scene("cloud", cloud(300, degree=3), _camera(64, 48))


def blobs() -> Scene:
    """Nearly round, opaque ones of 4 to 8 px, above the cut up to 3.3 sigma: `inria` draws some tiles of that."""
    rand, cam, count = _rand(8), _camera(64, 48), 40
    depths = 2 + 4 * rand(count)
    means = _at(rand(count, 2) * torch.tensor([64.0, 48.0]), depths, cam)
    scales = torch.log((4 + 4 * rand(count, 1)) * (1 - 0.05 * rand(count, 3)) * depths[:, None] / float(cam.K[0, 0]))
    gaussians = _gaussians(means, rand(count, 4) - 0.5, scales, 3 + 2 * rand(count), 2 * rand(count, 4, 3) - 0.8)
    return Scene("blobs", gaussians, cam)


def trained_like() -> Scene:
    """Many small, flat ones on two surfaces, mostly opaque or nearly transparent, as a fit leaves them."""
    rand, cam, count = _rand(1), _camera(56, 48), 700
    pixels = rand(count, 2) * torch.tensor([64.0, 56.0]) - 4
    depths = torch.where(rand(count) < 0.6, 3 + 0.3 * torch.sin(pixels[:, 0] / 9), 6 + 0.02 * pixels[:, 1]) + 0.05 * rand(count)
    footprint = depths / float(cam.K[0, 0])
    widths = torch.exp(1.2 * (rand(count, 3) - 0.4)) * torch.tensor([1.6, 1.1, 0.15])
    logits = torch.where(rand(count) < 0.5, 2 + 2 * rand(count), -3 + 2 * rand(count))
    sh = torch.cat([2.4 * rand(count, 1, 3) - 0.7, 0.2 * rand(count, 8, 3) - 0.1], 1)
    means = _at(pixels, depths, cam)
    return Scene("trained", _gaussians(means, rand(count, 4) - 0.5, torch.log(widths * footprint[:, None]), logits, sh), cam)


def strip() -> Scene:
    """One row of 2048 pixels."""
    rand, cam, count = _rand(2), _camera(2048, 1), 200
    pixels = torch.stack([rand(count) * 2048, 4 * rand(count) - 1.5], 1)
    depths = 2 + 4 * rand(count)
    scales = torch.log((0.5 + 8 * rand(count, 3)) * depths[:, None] / float(cam.K[0, 0]))
    means, sh = _at(pixels, depths, cam), 2 * rand(count, 4, 3) - 0.8
    return Scene("strip", _gaussians(means, rand(count, 4) - 0.5, scales, 4 * rand(count) - 1.5, sh), cam)


def far_right() -> Scene:
    """The right end of a picture 8192 px wide."""
    rand, cam, count = _rand(3), _camera(8192, 48), 150
    pixels = torch.stack([8128 + 64 * rand(count), 48 * rand(count)], 1)
    depths = 2 + 4 * rand(count)
    scales = torch.log((0.5 + 5 * rand(count, 3)) * depths[:, None] / float(cam.K[0, 0]))
    means, sh = _at(pixels, depths, cam), 2 * rand(count, 4, 3) - 0.8
    gaussians = _gaussians(means, rand(count, 4) - 0.5, scales, 4 * rand(count) - 1.5, sh)
    return Scene("far right", gaussians, cam, stress=True, window=(8128, 0, 64, 48))


def needles() -> Scene:
    """Axes of 30 to 300 px, the others at the pixel filter, in all directions."""
    rand, cam, count = _rand(4), _camera(64, 48), 60
    depths = 2 + 2 * rand(count)
    means = _at(rand(count, 2) * torch.tensor([64.0, 48.0]), depths, cam)
    turn = math.pi * rand(count) / 2
    quats = torch.stack([torch.cos(turn), 0.02 * rand(count), 0.02 * rand(count), torch.sin(turn)], 1)
    length = 30 * 10 ** rand(count)
    scales = torch.log(torch.stack([length, 0.01 + 0 * length, 0.01 + 0 * length], 1) * depths[:, None] / float(cam.K[0, 0]))
    return Scene(
        "needles", _gaussians(means, quats, scales, 3 * rand(count) - 1, 2 * rand(count, 1, 3) - 0.8), cam, stress=True
    )


def fog() -> Scene:
    """A thousand faint layers, all above the cut near their middles."""
    rand, cam, count = _rand(5), _camera(32, 24), 1000
    depths = 2 + 8 * (torch.arange(count) + 0.8 * rand(count)) / count  # none so close that rounding could swap two
    means = _at(rand(count, 2) * torch.tensor([32.0, 24.0]), depths, cam)
    scales = torch.log((6 + 14 * rand(count, 3)) * depths[:, None] / float(cam.K[0, 0]))
    logits = torch.logit(0.005 + 0.015 * rand(count))
    gaussians = _gaussians(means, rand(count, 4) - 0.5, scales, logits, 2 * rand(count, 1, 3) - 0.8)
    return Scene("fog", gaussians, cam, stress=True)


def faint_fog() -> Scene:
    """The same fog with every layer below the cut: rules draw nothing at all."""
    thick = fog()
    tensors = thick.gaussians.tensors() | {"logit_opacities": torch.full((1000,), math.log(0.0039 / (1 - 0.0039)))}
    return Scene("fog under the cut", Gaussians(**tensors), thick.camera, stress=True)


def wall() -> Scene:
    """Four walls of opaque Gaussians one behind another."""
    rand, cam = _rand(6), _camera(48, 32)
    ys, xs = torch.meshgrid(torch.arange(-2, 36, 4.0), torch.arange(-2, 52, 4.0), indexing="ij")
    grid = torch.stack([xs, ys], -1).view(-1, 2).double()
    pixels = torch.cat([grid + 2 * rand(len(grid), 2) for _ in range(4)])
    count = len(pixels)
    # none so close that rounding could swap two
    depths = (torch.arange(4.0)[:, None] + 2 + torch.linspace(0, 0.2, len(grid))).flatten().double()
    scales = torch.log((2 + 2 * rand(count, 3)) * depths[:, None] / float(cam.K[0, 0]))
    gaussians = _gaussians(
        _at(pixels, depths, cam), rand(count, 4) - 0.5, scales, 3 + 3 * rand(count), 2 * rand(count, 1, 3) - 0.6
    )
    return Scene("wall", gaussians, cam, stress=True)


def far_origin() -> Scene:
    """The cloud, seen by a turned camera, 100 u away from the origin, where float32 is spaced 7.6e-6 u."""
    gaussians, offset = cloud(300, degree=3), torch.tensor([57.0, -61.0, 55.0])
    turned = camera(64, 48, cameras=2)
    viewmat = turned.viewmat[1].clone()
    viewmat[:3, 3] -= viewmat[:3, :3] @ offset.double()
    cam = Camera(viewmat.float(), turned.K[1].float(), 64, 48)
    return Scene("far origin", Gaussians(**(gaussians.tensors() | {"means": gaussians.means + offset})), cam, stress=True)


def huge() -> Scene:
    """One Gaussian of 1e4 px behind thirty small ones."""
    g = cloud(31, seed=7, degree=1)
    g.means[0] = torch.tensor([0.3, -0.2, 6.0])
    g.log_scales[0] = math.log(1e4 * 6 / (1.2 * 64)) + torch.tensor([0.0, -0.3, 0.4])
    g.logit_opacities[0] = 1.0
    return Scene("huge", g, _camera(64, 48), stress=True)


SCENES: dict[str, Callable[[], Scene]] = {
    f.__name__: f
    for f in (random_cloud, blobs, trained_like, strip, far_right, needles, fog, faint_fog, wall, far_origin, huge)
}
