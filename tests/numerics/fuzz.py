"""Random scenes with poisoned Gaussians, 14 slots of each and 22 values, rendered and differentiated until enough were tried.

usage: python -m tests.numerics.fuzz [--device cpu] [--gaussians 1000000] [--seed 0] [--largest 8000]

Counted are Gaussians with at least one poisoned slot. One scene in four is small and is held against float64. A scene that
fails is named by the call that makes it again. Exit code 1 on a failure.
"""

import argparse
import math
import time
from dataclasses import dataclass

import torch

from tests.gaussians import SMOOTH, camera, cloud
from tests.reference.blend import blend_reference
from tests.reference.project import project_reference, rotations
from warpgs.constants import FAR, FARTHEST_PIXEL, LARGEST_AXIS, LARGEST_COEFFICIENT, RULES, SHORTEST_QUAT
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, Gaussians

SLOTS = (
    *(("means", k) for k in range(3)), *(("quats", k) for k in range(4)), *(("log_scales", k) for k in range(3)),
    ("logit_opacities", 0), *(("sh", k) for k in range(3)),
)  # fmt: skip
"""Tensor and column of each; of ``sh`` the colour channel, in a coefficient drawn at random."""

VALUES = (
    math.nan, -math.nan, math.inf, -math.inf, 0.0, -0.0,
    1.4e-45, -1.4e-45, 1.1754944e-38, -1.1754944e-38,  # smallest denormal and smallest normal number
    1e38, -1e38, 3.4028235e38, -3.4028235e38,
    1e-12, 0.01, 1 / 255, 1.0, 16.0, -16.0, 40.0, -44.4,  # near plane, cut, tile side, largest useful log scale, underflow
)  # fmt: skip

LRS = (0.05, 0.25, 0.5, 0.75, 0.95)
SIZES = ((1, 1), (33, 17), (48, 32), (70, 50))
ASPECT = 300.0
"""Longest over shortest axis of an ellipse up to which float32 input alone keeps weights within 1e-4 (docs/numerics.md)."""


@dataclass(frozen=True)
class Case:
    """One scene of the fuzz, on the CPU in float32; all of it follows from the seed and the number."""

    gaussians: Gaussians
    poisoned: torch.Tensor
    """True where at least one slot was overwritten, bool, shape [N]."""
    camera: Camera
    rule: str


def poison(gaussians: Gaussians, lr: float, generator: torch.Generator, values=VALUES) -> tuple[Gaussians, torch.Tensor]:
    """Overwrite slots of a share ``rate`` of the Gaussians: of half of these one slot, of the others up to all 14."""
    count = len(gaussians)

    def rand(*shape):
        return torch.rand(*shape, generator=generator)

    hit = rand(count) < lr
    fraction = torch.where(rand(count) < 0.5, 0.0, rand(count))
    mask = (rand(count, len(SLOTS)) < fraction[:, None]) | torch.nn.functional.one_hot(
        torch.randint(len(SLOTS), (count,), generator=generator), len(SLOTS)
    ).bool()
    mask &= hit[:, None]
    drawn = torch.tensor(values)[torch.randint(len(values), (count, len(SLOTS)), generator=generator)]
    coefficient = torch.randint(gaussians.sh.shape[1], (count,), generator=generator)
    tensors = {n: t.clone() for n, t in gaussians.tensors().items()}
    for slot, (name, column) in enumerate(SLOTS):
        rows = torch.nonzero(mask[:, slot])[:, 0]
        if name == "sh":
            tensors[name][rows, coefficient[rows], column] = drawn[rows, slot]
        else:
            tensors[name].view(count, -1)[rows, column] = drawn[rows, slot]
    return Gaussians(**tensors), hit


def make_case(seed: int, number: int, largest: int = 8000) -> Case:
    """Scene ``number`` of a fuzz: up to ``largest`` Gaussians, one or two cameras, any rule."""
    generator = torch.Generator().manual_seed(1_000_003 * seed + number)

    def pick(items):
        return items[int(torch.randint(len(items), (1,), generator=generator))]

    count = max(1, int(largest * 2.0 ** (-4 * float(torch.rand(1, generator=generator)))))
    size, lr, rule, cameras = pick(SIZES), pick(LRS), pick(sorted(RULES)), pick((1, 2))
    gaussians, hit = poison(cloud(count, seed=number), lr, generator)
    return Case(gaussians, hit, camera(*size, cameras=cameras, dtype=torch.float32), rule)


def non_finite(gaussians: Gaussians) -> torch.Tensor:
    """True where any parameter is NaN or infinite, bool, shape [N]; but scale 0 and opacity 1 have infinite logarithms."""
    meant = {"log_scales": -math.inf, "logit_opacities": math.inf}
    bad = {n: ~torch.isfinite(t.detach()) & (t.detach() != meant.get(n, 0.0)) for n, t in gaussians.tensors().items()}
    return torch.cat([b.reshape(len(gaussians), -1) for b in bad.values()], 1).any(1)


def _images(case: Case, keep: torch.Tensor, device) -> tuple[dict, torch.Tensor]:
    """Pictures and gradients of the Gaussians kept, by name, and which were drawn in some view."""
    tensors = {n: t[keep].to(device).requires_grad_() for n, t in case.gaussians.tensors().items()}
    views = Camera(case.camera.viewmat.to(device), case.camera.K.to(device), case.camera.width, case.camera.height)
    render = rasterize(Gaussians(**tensors), views, RasterizeOptions(rule=case.rule, background=(0.2, 0.5, 0.8)))
    generator = torch.Generator().manual_seed(1)
    loss = 0.0
    for image in (render.rgb, render.alpha, render.depth):
        loss = loss + (image * torch.randn(image.shape, generator=generator).to(device)).sum()
    gradients = torch.autograd.grad(loss, list(tensors.values()))
    found = {"rgb": render.rgb, "alpha": render.alpha, "depth": render.depth}
    found |= {f"v_{n}": v for n, v in zip(tensors, gradients)}
    return {n: t.detach() for n, t in found.items()}, render.visible.any(0).cpu()


def failures(case: Case, device) -> tuple[list[str], int]:
    """What is wrong with a scene whose non-finite Gaussians should not be there, and how many Gaussians were drawn of it."""
    wrong = []
    bad = non_finite(case.gaussians)
    found, drawn = _images(case, torch.ones_like(bad), device)
    for name, t in found.items():
        if not bool(torch.isfinite(t).all()):
            wrong.append(f"{name} is not finite in {int((~torch.isfinite(t)).sum())} of {t.numel()} numbers")
    if bool((drawn & bad).any()):
        wrong.append(f"{int((drawn & bad).sum())} Gaussians with a non-finite parameter were drawn")
    clean, _ = _images(case, ~bad, device)
    for name, t in found.items():
        if name.startswith("v_"):
            if bool(t[bad.to(device)].any()):
                wrong.append(f"{name} is not zero for a Gaussian with a non-finite parameter")
            t = t[~bad.to(device)]
        if not torch.equal(t, clean[name]):
            wrong.append(f"{name} changes when Gaussians with a non-finite parameter are taken away")
    return wrong, int(drawn.sum())


def documented(gaussians: Gaussians, cam: Camera, near: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Gaussians that docs/conventions.md lets through, and those 1e-4 from all limits and not longer than ASPECT, both [N]."""
    means, quats, log_scales, logits, sh = (t.double() for t in gaussians.tensors().values())
    view, K = cam.viewmat[0].double(), cam.K[0].double()
    p = means @ view[:3, :3].T + view[:3, 3]
    z = p[:, 2]
    pixel = torch.stack([K[0, 0] * p[:, 0] / z + K[0, 2], K[1, 1] * p[:, 1] / z + K[1, 2]], 1)
    size = torch.tensor([cam.width, cam.height])
    at = torch.minimum(torch.maximum(pixel, -0.15 * size), 1.15 * size)
    axes = view[:3, :3] @ rotations(quats) * torch.exp(log_scales)[:, None, :]
    focal = torch.stack([K[0, 0], K[1, 1]])
    rows = (focal[:, None] * axes[:, :2] + (K[:2, 2] - at)[..., None] * axes[:, 2:]) / z[:, None, None]
    length, coefficient = quats.norm(dim=1), sh.abs().flatten(1).amax(1)
    limits = [
        (z, near, FAR), (pixel.abs().amax(1), 0.0, FARTHEST_PIXEL), (length, SHORTEST_QUAT, 1 / SHORTEST_QUAT),
        (rows.abs().flatten(1).amax(1), 0.0, LARGEST_AXIS), (coefficient, 0.0, LARGEST_COEFFICIENT),
    ]  # fmt: skip
    inside, clear = torch.sigmoid(logits) > 0, torch.ones(len(z), dtype=torch.bool)
    for value, low, high in limits:
        inside &= (value >= low) & (value <= high)
        clear &= ((value - low).abs() > 1e-4 * low) & ((value - high).abs() > 1e-4 * high)
    rows = torch.where(inside[:, None, None], rows, 1.0)
    spread = torch.linalg.eigvalsh(rows @ rows.transpose(1, 2) + SMOOTH.low_pass * torch.eye(2, dtype=torch.float64))
    round_enough = spread[:, 1] <= ASPECT**2 * spread[:, 0]
    return inside, clear & round_enough


def reference_error(seed: int, number: int, device, count: int = 24) -> tuple[float, int, int]:
    """Largest difference of a scene of finite extremes from float64, over the largest value; counts of compared, drawn."""
    generator = torch.Generator().manual_seed(1_000_003 * seed + number)
    finite = [v for v in VALUES if math.isfinite(v)]
    gaussians, _ = poison(cloud(count, seed=number), 0.8, generator, finite)
    cam = camera(24, 20, cameras=1, dtype=torch.float32)
    _, safe = documented(gaussians, cam, SMOOTH.near)
    gaussians = Gaussians(**{n: t[safe] for n, t in gaussians.tensors().items()})
    inside, _ = documented(gaussians, cam, SMOOTH.near)
    moved = Gaussians(**{n: t.to(device) for n, t in gaussians.tensors().items()})
    r = rasterize(moved, Camera(cam.viewmat.to(device), cam.K.to(device), 24, 20), RasterizeOptions(rule=SMOOTH))
    drawn = r.visible[0].cpu()
    if not torch.equal(drawn, inside):
        return math.inf, len(gaussians), int(drawn.sum())
    if not bool(inside.any()):
        return 0.0, len(gaussians), 0
    tensors = [t[inside].double() for t in gaussians.tensors().values()]
    means, covs, colors, depths, opacities = project_reference(
        *tensors, cam.viewmat.double(), cam.K.double(), width=24, height=20, degree=1, low_pass=SMOOTH.low_pass
    )
    black = torch.zeros(3, dtype=torch.float64)
    rgb, alpha, depth, _ = blend_reference(means[0], covs[0], opacities, colors[0], depths[0], black, 24, 20, SMOOTH)
    found = [t[0].cpu().double() for t in (r.rgb, r.alpha, r.depth)]
    bright = max(1.0, float(tensors[4].abs().max()))
    errors = [
        (found[0] - rgb).abs().max() / bright, (found[1] - alpha).abs().max(),
        (found[2] * found[1] - depth * alpha).abs().max() / max(1.0, float(depths.max())),
    ]  # fmt: skip
    return max(float(e) if math.isfinite(e) else math.inf for e in errors), len(gaussians), int(drawn.sum())


REFERENCE_LIMIT = 1e-4
"""Most that a picture of finite extremes may differ from float64; measured 1.1e-6; see `ASPECT`."""


def fuzz(device: str, gaussians: int, seed: int, largest: int) -> int:
    """Try scenes until ``gaussians`` poisoned Gaussians were seen; prints counts, returns the number of failures."""
    begin = time.perf_counter()
    scenes = tried = broken = drawn = compared = shown = failed = 0
    worst = 0.0
    while tried < gaussians:
        case = make_case(seed, scenes, largest)
        try:
            wrong, seen = failures(case, device)
        except Exception as e:  # a crash is what is looked for; the scene is kept and the fuzz goes on
            wrong, seen = [f"{type(e).__name__}: {e}"], 0
        if scenes % 4 == 0:
            error, some, visible = reference_error(seed, scenes, device)
            worst, compared, shown = max(worst, error), compared + some, shown + visible
            if not error <= REFERENCE_LIMIT:
                wrong.append(f"reference_error({seed}, {scenes}, {device!r}) is {error:.2e}, above {REFERENCE_LIMIT:.0e}")
        if wrong:
            failed += 1
            print(f"make_case({seed}, {scenes}, {largest}), rule {case.rule}: " + "; ".join(wrong))
        scenes, tried, drawn = scenes + 1, tried + int(case.poisoned.sum()), drawn + seen
        broken += int(non_finite(case.gaussians).sum())
        if scenes % 50 == 0:
            seconds = time.perf_counter() - begin
            print(f"{scenes} scenes, {tried:,} poisoned Gaussians, {failed} failures, {seconds:.0f} s", flush=True)
    print(
        f"{scenes} scenes on {device}, {len(VALUES)} values in 14 slots of up to {max(LRS):.0%} of the Gaussians: {tried:,} "
        f"poisoned, {broken:,} of them with a non-finite parameter, {drawn:,} drawn, poisoned or not; float64 compared with "
        f"{compared:,}, {shown:,} of them drawn, largest difference {worst:.1e}"
    )
    print(f"{failed} failures in {tried:,} poisoned Gaussians, seed {seed}, {time.perf_counter() - begin:.0f} s")
    return failed


def main() -> int:
    """The program; returns its exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--gaussians", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--largest", type=int, default=8000, help="Gaussians of the largest scenes")
    a = parser.parse_args()
    return int(fuzz(a.device, a.gaussians, a.seed, a.largest) > 0)


if __name__ == "__main__":
    raise SystemExit(main())
