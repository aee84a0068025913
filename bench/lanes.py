"""CPU blending per lane, against naive kernels, on a seeded cloud; prints what the cloud is made of.

A lane is one (Gaussian, pixel) pair that the row loop evaluates: rows are clipped to the Gaussian's box, columns are not.
The naive kernels have no box: a thread walks its tile's list. All times are those of the whole op, its memory included.
Interleaved, and the minimum of each, because other work on the machine only ever adds; one thread by its CPU time, two by
the clock on the wall.

usage: python -m bench.lanes [--repeats 15] [--gaussians 20000]
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable

import torch

from bench.inputs import camera
from bench.naive import Naive
from warpgs.constants import RULES
from warpgs.kernels.blend import blend
from warpgs.kernels.project import project
from warpgs.kernels.tiles import Tiles, bin_tiles

WIDTH, HEIGHT = 512, 384
SIGMAS = (2.0, 12.0)
"""Standard deviations on the image [px], log-uniform, the two axes apart."""
OPACITIES = (0.02, 0.5)
"""Log-uniform."""


def cloud(count: int) -> tuple[torch.Tensor, Tiles]:
    """Records and tiles of round and long Gaussians all over the image, most of them faint, as in a scene half fitted."""
    g = torch.Generator().manual_seed(0)

    def log_uniform(bounds: tuple[float, float], *shape: int) -> torch.Tensor:
        low, high = torch.tensor(bounds).log()
        return torch.exp(low + (high - low) * torch.rand(shape, generator=g))

    cam, depth = camera(WIDTH, HEIGHT, torch.device("cpu")), 4 + 2 * torch.rand(count, 1, generator=g)
    focal = cam.K[0, 0, 0]
    pixels = torch.rand(count, 2, generator=g) * torch.tensor([WIDTH, HEIGHT]) - cam.K[0, :2, 2]
    opacities = log_uniform(OPACITIES, count)
    tensors = [
        torch.cat([pixels * depth / focal, depth], 1),
        torch.randn(count, 4, generator=g),
        torch.log(log_uniform(SIGMAS, count, 3) * depth / focal),
        torch.logit(opacities),
        torch.randn(count, 1, 3, generator=g) * 0.3,
    ]
    size, rule = {"width": WIDTH, "height": HEIGHT}, RULES["exact"]
    splats, counts = project(*tensors, cam.viewmat, cam.K, **size, degree=0, rule=rule)
    return splats, bin_tiles(splats, counts, **size, rule=rule)


def lanes(splats: torch.Tensor, tiles: Tiles, drawn_until: torch.Tensor) -> int:
    """Lanes of the instances before the last one that each tile draws, by the formula of the kernels."""
    first, last = tiles.ranges.long().unbind(1)
    last = torch.minimum(last, drawn_until)
    tile = torch.repeat_interleave(torch.arange(len(first)), (last - first).clamp(min=0))
    begin = torch.cumsum((last - first).clamp(min=0), 0) - (last - first).clamp(min=0)
    instance = torch.arange(len(tile)) - begin[tile] + first[tile]
    s = splats[0, tiles.splat_ids[instance].long()]
    center = s[:, 1] - (tile // (WIDTH // tiles.size)) * tiles.size - 0.5
    half = s[:, 11] + 0.01 + 2e-6 * (s[:, 1].abs() + s[:, 11])
    rows = (center + half).clamp(-1, tiles.size - 1).floor() + 1 - (center - half).clamp(0, tiles.size).ceil()
    return int(rows.clamp(min=0).sum()) * tiles.size


def fastest(works: dict[str, Callable[[], object]], repeats: int, clock: Callable[[], int]) -> dict[str, float]:
    """Smallest time of each [ns], taken in turn."""
    best = dict.fromkeys(works, float("inf"))
    for _ in range(repeats):
        for name, work in works.items():
            begin = clock()
            work()
            best[name] = min(best[name], clock() - begin)
    return best


def main() -> None:
    """Print the inputs, then nanoseconds per lane, the naive kernels' and the ratio, and what a second thread gives."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--gaussians", type=int, default=20_000)
    a = parser.parse_args()
    size, rule, background = {"width": WIDTH, "height": HEIGHT}, RULES["exact"], torch.zeros(1, 3)
    splats, tiles = cloud(a.gaussians)
    leaf = splats.detach().requires_grad_()
    rgb, alpha, _ = blend(leaf, tiles, background, **size, rule=rule)
    naive = Naive(splats, tiles, background, **size, rule=rule)
    v_rgb = torch.rand(rgb.shape, generator=torch.Generator().manual_seed(1))
    naive.forward()
    pixel_ends = naive.kept[1].view(HEIGHT // tiles.size, tiles.size, WIDTH // tiles.size, tiles.size)
    evaluated = lanes(splats, tiles, pixel_ends.amax((1, 3)).view(-1).long())
    instances = len(tiles.slots)
    print(
        f"{a.gaussians:,} Gaussians on {WIDTH} x {HEIGHT} px: sigma {SIGMAS[0]:g} to {SIGMAS[1]:g} px, "
        f"opacity {OPACITIES[0]:g} to {OPACITIES[1]:g}, both log-uniform\n"
        f"{instances:,} instances, {instances / len(tiles.ranges):.0f} a tile; {instances * tiles.size**2 / 1e6:.1f}M pairs "
        f"in their tiles, {evaluated / 1e6:.1f}M lanes evaluated; mean alpha of the image {float(alpha.detach().mean()):.2f}"
    )

    def forward() -> torch.Tensor:
        return blend(leaf, tiles, background, **size, rule=rule)[0]

    def backward() -> object:
        return torch.autograd.grad(rgb, [leaf], v_rgb, retain_graph=True)

    torch.set_num_threads(1)
    works = {"forward": forward, "backward": backward}
    naives = {"naive forward": naive.forward, "naive backward": lambda: naive.backward(v_rgb)}
    one = fastest(works | naives, a.repeats, time.process_time_ns)
    walls, counts = {}, [2**k for k in range(8) if 2**k <= (os.cpu_count() or 1)]
    for threads in counts:
        torch.set_num_threads(threads)
        walls[threads] = fastest(works, 2 * a.repeats, time.perf_counter_ns)
    for name in works:
        slow = one["naive " + name]
        gains = "  ".join(f"{n} threads {walls[1][name] / walls[n][name]:.2f} x" for n in counts[1:])
        print(
            f"{name:<9} {one[name] / 1e6:8.2f} ms  {one[name] / evaluated:.2f} ns a lane  naive {slow / 1e6:8.1f} ms  "
            f"{slow / one[name]:5.1f} x  {gains}"
        )


if __name__ == "__main__":
    main()
