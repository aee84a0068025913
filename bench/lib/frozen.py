"""Fixed scenes for comparing speed and accuracy: scenes like those of training, and scenes that are hard for arithmetic."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from bench.lib import inputs
from warpgs.pipeline.run.folder import open_run
from warpgs.scene import C0, Camera, Gaussians


@dataclass(frozen=True)
class Frozen:
    """One scene."""

    name: str
    what: str
    """Description of the scene."""
    gaussians: Gaussians
    """Float32, on the device."""
    camera: Camera


def _normal(generator: torch.Generator, *shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def _uniform(generator: torch.Generator, *shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=generator, dtype=torch.float64)


def _make(means, log_scales, logits, colors, quats=None) -> Gaussians:
    sh = torch.zeros(len(means), 1, 3, dtype=torch.float64)
    sh[:, 0] = (colors - 0.5) / C0
    quats = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(len(means), 4) if quats is None else quats
    return Gaussians(means, quats, log_scales, logits, sh)


def generated(count: int, seed: int) -> Gaussians:
    """Return Gaussians like those of a fit: flat and long ones on a few slanted sheets, most of them faint or opaque."""
    g = torch.Generator().manual_seed(seed)
    sheet = torch.randint(0, 5, (count,), generator=g)
    across = (_uniform(g, count, 2) - 0.5) * torch.tensor([4.4, 3.4], dtype=torch.float64)
    depth = 2.5 + 0.8 * sheet + 0.25 * across[:, 0] * torch.cos(sheet * 1.7) + 0.02 * _normal(g, count)
    means = torch.cat([across * (depth / 3)[:, None], depth[:, None]], 1)
    size = 1.6 * count**-0.5 * torch.exp(0.6 * _normal(g, count, 1))
    shape = torch.exp(torch.tensor([0.6, 0.6, 0.3]) * _normal(g, count, 3)) * torch.tensor([1.0, 0.7, 0.12])
    logits = torch.where(_uniform(g, count) < 0.6, -2.2 + _normal(g, count), 3.0 + _normal(g, count))
    made = _make(
        means,
        torch.log(size * shape),
        logits,
        _uniform(g, count, 3),
        torch.tensor([1.0, 0, 0, 0]) + 0.25 * _normal(g, count, 4),
    )
    rest = 0.08 * _normal(g, count, 15, 3)
    return dataclasses.replace(made, sh=torch.cat([made.sh, rest], 1))


def needles(count: int, seed: int) -> Gaussians:
    """Return needles: long axes of 30 to 300 px in an image 500 px wide, the other axes far below a pixel."""
    g = torch.Generator().manual_seed(seed)
    means = (_uniform(g, count, 3) - 0.5) * torch.tensor([4.0, 3.0, 1.0]) + torch.tensor([0.0, 0, 4.0])
    long = torch.log(0.26 * 10 ** _uniform(g, count))
    scales = torch.stack([long, torch.full_like(long, -7.0), torch.full_like(long, -7.0)], 1)
    return _make(means, scales, _normal(g, count), _uniform(g, count, 3), _normal(g, count, 4))


def fog(layers: int, seed: int, alpha: float = 0.0039) -> Gaussians:
    """Return layers that fill the image. With alpha 0.0039, below 1/255, they are 98 % opaque together, but all are cut."""
    g = torch.Generator().manual_seed(seed)
    means = torch.zeros(layers, 3, dtype=torch.float64)
    means[:, 2] = torch.linspace(2, 6, layers, dtype=torch.float64)
    logits = torch.full((layers,), float(torch.logit(torch.tensor(alpha, dtype=torch.float64))), dtype=torch.float64)
    return _make(means, torch.full((layers, 3), 5.0, dtype=torch.float64), logits, _uniform(g, layers, 3))


def wall(count: int, seed: int) -> Gaussians:
    """Return ten opaque sheets, one behind the other: all but the first two are hidden."""
    g = torch.Generator().manual_seed(seed)
    means = (_uniform(g, count, 3) - 0.5) * torch.tensor([5.0, 4.0, 0.02]) + torch.tensor([0.0, 0, 3.0])
    means[:, 2] += 0.3 * torch.randint(0, 10, (count,), generator=g)
    scales = torch.log(12.0 * count**-0.5 * (0.5 + _uniform(g, count, 3)))
    return _make(means, scales, torch.full((count,), 6.0, dtype=torch.float64), _uniform(g, count, 3))


def huge(count: int, seed: int) -> Gaussians:
    """Return one Gaussian of ten thousand pixels in front of those of `generated`."""
    base = generated(count, seed)
    one = _make(
        torch.tensor([[0.3, 0.2, 1.0]]), torch.tensor([[3.0, 2.5, -3.0]]), torch.tensor([0.0]), torch.tensor([[0.9, 0.4, 0.1]]),
        torch.tensor([[1.0, 0.1, 0.2, 0.3]]),
    )  # fmt: skip
    one = dataclasses.replace(one, sh=torch.nn.functional.pad(one.sh, (0, 0, 0, 15)))
    return Gaussians(*(torch.cat([a.to(b), b]) for a, b in zip(one.tensors().values(), base.tensors().values())))


FAR = 1000.0
"""Distance of the far scene from the origin [u]."""


def scenes(
    device: torch.device, width: int, height: int, count: int, run: Path | None, seed: int
) -> list[Callable[[], Frozen]]:
    """Return a function for each scene; ``run`` is a run folder whose first view is added as the first scene."""
    camera = inputs.camera(width, height, torch.device("cpu"))
    camera = Camera(camera.viewmat[0].double().numpy(), camera.K[0].double().numpy(), width, height)

    def trained() -> Frozen:
        if run is None:
            return Frozen("trained", f"{count:,} Gaussians like those of a fit", generated(count, seed), camera)
        stored = open_run(run, torch.device("cpu"))
        name, place = next(iter(stored.cameras().items()))
        words = f"{Path(stored.record['scene']['path']).name}, {len(stored.gaussians()):,} Gaussians after {stored.step} steps"
        return Frozen("trained", f"{words}, view {name}", stored.gaussians(), place)

    def far() -> Frozen:
        base, offset = generated(count, seed), torch.tensor([FAR, -FAR, FAR], dtype=torch.float64)
        viewmat, turn = np.eye(4), 0.1  # [rad]; turned, or the offset would cancel without rounding
        viewmat[:3, :3] = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
        viewmat[:3, 3] = -viewmat[:3, :3] @ offset.numpy()
        moved = dataclasses.replace(base, means=(base.means + offset).float().double())  # as it is stored
        return Frozen("far", f"the same {FAR:,.0f} u from the origin", moved, dataclasses.replace(camera, viewmat=viewmat))

    def of(name: str, what: str, gaussians: Callable[[], Gaussians]) -> Callable[[], Frozen]:
        return lambda: Frozen(name, what, gaussians(), camera)

    makers = [
        trained,
        of("needles", "2,000 needles of 30 to 300 px", lambda: needles(2000, seed)),
        of("fog", "1,000 layers of alpha 0.0039", lambda: fog(1000, seed)),
        of("wall", "ten opaque sheets", lambda: wall(count, seed)),
        far,
        of("huge", "one Gaussian of 10,000 px before many", lambda: huge(count, seed)),
    ]

    def placed(make: Callable[[], Frozen]) -> Callable[[], Frozen]:
        def on_device() -> Frozen:
            made = make()
            tensors = {n: t.to(device, torch.float32).contiguous() for n, t in made.gaussians.tensors().items()}
            return dataclasses.replace(made, gaussians=Gaussians(**tensors))

        return on_device

    return [placed(make) for make in makers]
