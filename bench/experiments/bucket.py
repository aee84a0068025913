"""Backward pass of blending by buckets, a lane per Gaussian, against the product's by chunks: same inputs, same outputs.

usage: python -m bench.experiments.bucket GARDEN.npz [--out FILE.json] [--only NAME] [--depth] [--repeats 30]
Needs a CUDA device; GARDEN.npz as for bench.garden. For each size all gradients are compared first. Then the kernels are timed,
one launch each in turn, between events, and with them the forward kernel that leaves states for either. The last lines are
a table; the exit code is 1 if gradients disagree.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import torch
import warp as wp

from bench import result_file
from bench.against_gsplat import CONFIGURATIONS, first_camera, quartiles
from bench.experiments.bucket_kernel import SIZES, VALUES, make_backward
from bench.garden import garden_inputs
from warpgs.constants import RULES, Rule
from warpgs.kernels import blend_cuda
from warpgs.kernels.blend_settings import BlendSettings
from warpgs.kernels.project import project
from warpgs.kernels.tiles import Tiles, bin_tiles
from warpgs.runtime import interop
from warpgs.scene import Camera, Gaussians

WHAT = "the backward pass of blending by buckets against the one in use: gradients and time"
NAMES = ("112k at 504x378", "2.8M at 1920x1080", "2.8M at 3840x2160")
REPEATS, WARM_UP = 30, 5
TOLERANCE = 1e-5
"""Relative distance (L2) between the gradients of two kernels up to which they agree, for every one of the values."""
STATES = -5
"""Place of the states among the arguments of the backward kernels."""


@dataclass(frozen=True)
class Launch:
    """A launch of the product, put off."""

    kernel: object
    count: int
    inputs: list
    device: torch.device
    how: dict

    def __call__(self) -> None:
        interop.launch(self.kernel, self.count, self.inputs, self.device, **self.how)


def put_off(work: Callable, *inputs, **options) -> tuple[object, list[Launch]]:
    """Return the result of a function of the product, its memory not written yet, and the launches that would write it."""
    launches = []

    def note(kernel, count, arguments, device, **how):
        launches.append(Launch(kernel, count, arguments, device, how))

    with mock.patch.object(interop, "launch", note):
        result = work(*inputs, **options)
    return result, launches


class Case:
    """One image: forward launches by distance of states, the product's backward launch, and its variants.

    A variant is the product's kernel with another size of chunk, or one by buckets.

    Args:
        projected: Projected Gaussians of `project`, shape [C, N, 12].
        tiles: Their instances.
        width: Image width [px].
        height: Image height [px].
        rule: Cut-offs.
        upstream: Gradients of colour [C, H, W, 3], and of alpha and depth [C, H, W] or None for neither.
    """

    def __init__(self, projected: torch.Tensor, tiles: Tiles, width: int, height: int, rule: Rule, upstream: tuple):
        backgrounds = torch.full((len(projected), 3), 0.3, device=projected.device)
        how = (projected, tiles, backgrounds, BlendSettings((0, 0), width, height, rule))
        chunk = blend_cuda.chunk_of(tiles, True)
        self.chunk, self.instances, self.tiles = chunk, len(tiles.slots), tiles
        self.values = 9 if upstream[1] is None else VALUES
        self.forward, states = {}, {}
        for size in SIZES:
            with mock.patch.object(blend_cuda, "chunk_of", return_value=size):
                (rgb, _, depth, *kept), (order, self.forward[size]) = put_off(blend_cuda.forward, *how, save=True)
            order()
            self.forward[size]()
            states[size] = kept[-1]
            if size == chunk:
                saved = (rgb, depth, *kept)
        self.v_projected, (self.backward, self.gather) = put_off(blend_cuda.backward, *how, saved, upstream)
        assert self.backward.inputs[STATES].tensor is states[chunk]
        self.v_slots = self.backward.inputs[-1].tensor
        self.state_mib = {size: t.numel() * 4 / 2**20 for size, t in states.items()}
        with_depth = self.values == VALUES
        kernels = {f"chunks of {n}": (blend_cuda.make_backward(tiles.size, with_depth, n, False).backward, n) for n in SIZES}
        kernels["bucket 32, all pixels"] = make_backward(tiles.size, with_depth, 32, False), 32
        kernels |= {f"bucket {n}": (make_backward(tiles.size, with_depth, n, True), n) for n in SIZES}
        self.name = f"chunks of {chunk}"
        self.variants = {name: self._variant(*k, states) for name, k in kernels.items() if name != self.name}

    def _variant(self, kernel, size: int, states: dict) -> Launch:
        inputs = list(self.backward.inputs)
        inputs[STATES] = interop.view(states[size], wp.float32)
        count = 32 * -(-self.instances // size)
        return Launch(kernel, count, inputs, self.backward.device, {"block_dim": 32 * blend_cuda.WARPS})

    def gradients(self, backward: Launch) -> tuple[torch.Tensor, torch.Tensor]:
        """Sums of each instance, shape [M, 9 or 10], and gradients of the records, [C, N, 12]; NaN where none was written."""
        self.v_slots.fill_(torch.nan)
        self.v_projected.fill_(torch.nan)
        backward()
        self.gather()
        return self.v_slots[:, : self.values].clone(), self.v_projected.clone()

    def disagreements(self) -> dict[str, dict]:
        """Distance of each variant's gradients from the product's, relative, the largest among the values."""
        wanted, result = self.gradients(self.backward), {}
        for name, variant in self.variants.items():
            found = self.gradients(variant)
            result[name] = {
                "instances": max(distance(found[0][:, k], wanted[0][:, k]) for k in range(self.values)),
                "records": max(distance(found[1][..., k], wanted[1][..., k]) for k in range(self.values)),
            }
        return result

    def works(self) -> dict[str, Launch]:
        """Return the launches that are timed, by name."""
        forward = {f"forward, states at {size}": launch for size, launch in self.forward.items()}
        return forward | {self.name: self.backward} | self.variants


def distance(found: torch.Tensor, wanted: torch.Tensor) -> float:
    """Return the L2 distance of two tensors relative to the second; NaN if any entry is."""
    return float(torch.linalg.vector_norm(found.double() - wanted.double()) / torch.linalg.vector_norm(wanted.double()))


def agrees(row: dict) -> bool:
    """Return whether all distances are within the tolerance; NaN is not."""
    return all(d <= TOLERANCE for errors in row["disagreement"].values() for d in errors.values())


def times_in_turn(works: dict[str, Callable], repeats: int) -> dict[str, dict]:
    """GPU time of each work [us], one repeat each in turn. The host runs ahead, so that no launch is waited for."""
    marks = {name: [] for name in works}
    for i in range(WARM_UP + repeats):
        for name, work in works.items():
            begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
            begin.record()
            work()
            end.record()
            if i >= WARM_UP:
                marks[name].append((begin, end))
    torch.cuda.synchronize()
    return {name: quartiles([1000 * begin.elapsed_time(end) for begin, end in own]) for name, own in marks.items()}


def case_of(gaussians: Gaussians, camera: Camera, rule: Rule, with_depth: bool) -> Case:
    """The image of a batch of cameras, with random gradients of it."""
    size = {"width": camera.width, "height": camera.height}
    with torch.no_grad():
        tensors = gaussians.tensors().values()
        projected, counts = project(*tensors, camera.viewmat, camera.K, **size, degree=gaussians.sh_degree, rule=rule)
        tiles = bin_tiles(projected, counts, **size, rule=rule)
    generator = torch.Generator(projected.device).manual_seed(1)

    def rand(*shape):
        return torch.rand(len(projected), camera.height, camera.width, *shape, device=projected.device, generator=generator)

    return Case(
        projected, tiles, *size.values(), rule, (rand(3), rand() if with_depth else None, rand() if with_depth else None)
    )


def measure(case: Case, repeats: int) -> dict:
    """Agreement, times and sizes of one case."""
    row = {"tiles": len(case.tiles.ranges), "instances": case.instances, "chunk": case.chunk}
    row |= {"disagreement": case.disagreements(), "gpu_us": times_in_turn(case.works(), repeats)}
    return row | {"state_mib": {str(size): round(mib, 1) for size, mib in case.state_mib.items()}}


def table(rows: list[dict]) -> str:
    """Medians and quartiles of all kernels [us], a column for each size; agreement below."""
    lines = []
    for row in rows:
        lines.append(f"{row['configuration']}: {row['instances']:,} instances, states {row['state_mib']} MiB")
        base = row["gpu_us"][f"chunks of {row['chunk']}"]["median"]
        for name, t in row["gpu_us"].items():
            low, high = t["quartiles"]
            line = f"  {name:<24} {t['median']:9.1f} us [{low:.1f}, {high:.1f}]"
            if not name.startswith("forward"):
                line += f"  {t['median'] / base:5.2f} of the product's"
            if name in row["disagreement"]:
                errors = row["disagreement"][name]
                line += f"  off by {errors['instances']:.1e} (instances), {errors['records']:.1e} (records)"
            lines.append(line)
        lines.append("  gradients agree" if agrees(row) else f"  GRADIENTS DISAGREE by more than {TOLERANCE:g}")
    return "\n".join(lines)


def main() -> None:
    """Compare, time, write, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("garden")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--only", help="a size's name, or its beginning")
    parser.add_argument("--depth", action="store_true", help="with gradients of depth and alpha")
    parser.add_argument("--repeats", type=int, default=REPEATS)
    a = parser.parse_args()
    rows = []
    for name in NAMES:
        if a.only and not name.startswith(a.only):
            continue
        cells, width, height = CONFIGURATIONS[name]
        gaussians, cameras = garden_inputs(a.garden, tiles=cells, sh_degree=3, width=width, height=height)
        case = case_of(gaussians, first_camera(cameras), RULES["gsplat"], a.depth)
        rows.append({"configuration": name, "depth": a.depth} | measure(case, a.repeats))
        del case, gaussians
        torch.cuda.empty_cache()
        result_file.write(a.out, result_file.result(WHAT, torch.device("cuda"), rows))  # nothing is lost if the next size fails
        print(f"{name} done", flush=True)
    print(table(rows))
    if not all(agrees(row) for row in rows):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
