"""CPU blending per lane, against naive kernels, on a seeded cloud; prints the contents of the cloud.

A lane is one (Gaussian, pixel) pair that the inner loop evaluates. Lanes are in strips of eight pixels that the Gaussian's
ellipse touches, until the last pixel of the strip is finished. The forward pass checks for finished strips once per batch, and
so evaluates a few more. A boxed lane is a pixel of a row of the tile that the Gaussian's box touches, until the tile is
finished. A kernel that clips boxes by rows alone evaluates boxed lanes. The naive kernels have no box: a thread reads its
tile's list. All times are those of the whole op, including memory. Programs run interleaved, and the minimum of each is
reported, because other work on the machine only adds time. One thread is measured by CPU time, two threads by wall time.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable

import torch

from bench.lib.arguments import parse
from bench.lib.inputs import camera
from bench.lib.naive import Naive
from warpgs.constants import RULES
from warpgs.kernels.blend import blend
from warpgs.kernels.falloff import STRIP
from warpgs.kernels.project import project
from warpgs.kernels.tiles import Tiles, bin_tiles

WIDTH, HEIGHT = 512, 384
SIGMAS = (2.0, 12.0)
"""Range of the standard deviations on the image [px], log-uniform, sampled separately for both axes."""
OPACITIES = (0.02, 0.5)
"""Range of the opacities, log-uniform."""


def cloud(count: int) -> tuple[torch.Tensor, Tiles]:
    """Return records and tiles of round and long Gaussians all over the image, most of them faint, as halfway through a fit."""
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
    projected, counts = project(*tensors, cam.viewmat, cam.K, **size, degree=0, rule=rule)
    return projected, bin_tiles(projected, counts, **size, rule=rule)


def lanes(projected: torch.Tensor, tiles: Tiles, pixel_ends: torch.Tensor) -> tuple[int, int]:
    """Return the lanes evaluated and the boxed lanes, by the formulas of the kernels; ``pixel_ends`` has the image shape."""
    side, strips = tiles.size, tiles.size // STRIP
    ends = pixel_ends.view(HEIGHT // side, side, WIDTH // side, strips, STRIP).amax(4).permute(0, 2, 1, 3).flatten(0, 1)
    first, last = tiles.ranges.long().unbind(1)
    count = (torch.minimum(last, ends.amax((1, 2))) - first).clamp(min=0)
    tile = torch.repeat_interleave(torch.arange(len(first)), count)
    instance = torch.arange(len(tile)) - (torch.cumsum(count, 0) - count - first)[tile]
    mx, my, u11, u12, u22, *_, half_width, half_height = projected[0, tiles.gaussian_ids[instance].long()].unbind(1)
    top, left = tile // (WIDTH // side) * side + 0.5, tile % (WIDTH // side) * side + 0.5
    margin, slack = (0.01 + 2e-6 * (m.abs() + half) for m, half in ((mx, half_width), (my, half_height)))
    evaluated = boxed = 0
    for row in range(side):
        dy = top + row - my
        boxed += side * int((dy.abs() <= half_height + slack).sum())
        for strip in range(strips):
            middle = left + STRIP * strip + (STRIP - 1) / 2 - mx
            least = ((u11 * middle + u12 * dy).abs() - u11 * ((STRIP - 1) / 2 + margin)).clamp(min=0)
            reached = least**2 + (u22 * dy) ** 2 <= (u22 * (half_height + slack)) ** 2
            evaluated += STRIP * int((reached & (instance < ends[tile, row, strip])).sum())
    return evaluated, boxed


def fastest(works: dict[str, Callable[[], object]], repeats: int, clock: Callable[[], int]) -> dict[str, float]:
    """Return the shortest time of each function [ns]; the functions run in turn."""
    best = dict.fromkeys(works, float("inf"))
    for _ in range(repeats):
        for name, work in works.items():
            begin = clock()
            work()
            best[name] = min(best[name], clock() - begin)
    return best


def main() -> None:
    """Print the inputs, then nanoseconds per lane, the times of naive kernels, ratios, and the speed-up by a second thread."""
    a = parse(__doc__, repeats=15, gaussians=20_000)
    size, rule, background = {"width": WIDTH, "height": HEIGHT}, RULES["exact"], torch.zeros(1, 3)
    projected, tiles = cloud(a.gaussians)
    leaf = projected.detach().requires_grad_()
    rgb, alpha, _ = blend(leaf, tiles, background, **size, rule=rule)
    naive = Naive(projected, tiles, background, **size, rule=rule)
    v_rgb = torch.rand(rgb.shape, generator=torch.Generator().manual_seed(1))
    naive.forward()
    evaluated, boxed = lanes(projected.detach(), tiles, naive.kept[1].long())
    instances = len(tiles.slots)
    print(
        f"{a.gaussians:,} Gaussians on {WIDTH} x {HEIGHT} px: sigma {SIGMAS[0]:g} to {SIGMAS[1]:g} px, "
        f"opacity {OPACITIES[0]:g} to {OPACITIES[1]:g}, both log-uniform\n"
        f"{instances:,} instances, {instances / len(tiles.ranges):.0f} a tile; {instances * tiles.size**2 / 1e6:.1f}M pairs "
        f"in their tiles, {boxed / 1e6:.1f}M boxed lanes, {evaluated / 1e6:.1f}M evaluated; "
        f"mean alpha of the image {float(alpha.detach().mean()):.2f}"
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
            f"{name:<9} {one[name] / 1e6:8.2f} ms  {one[name] / evaluated:.2f} ns a lane  {one[name] / boxed:.2f} boxed  "
            f"naive {slow / 1e6:8.1f} ms  {slow / one[name]:5.1f} x  {gains}"
        )


if __name__ == "__main__":
    main()
