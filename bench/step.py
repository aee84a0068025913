"""Time of one training step, stage by stage, on a real or synthetic scene.

usage: python -m bench.step SCENE [--split llff:3] [--downscale 1] [--gaussians 100000] [--device auto] [--out FILE.json]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from bench import result_file
from bench.harness import measure
from bench.training import Trainer, make_trainer, one_step, step_parts
from warpgs import load_scene
from warpgs.constants import RULES
from warpgs.io.splits import split_views
from warpgs.kernels.blend import blend
from warpgs.kernels.project import project
from warpgs.kernels.tiles import bin_tiles
from warpgs.pipeline.model.init import InitConfig
from warpgs.pipeline.runs.request import choose_device
from warpgs.pipeline.train.config import FitConfig
from warpgs.pipeline.train.loss import photometric_loss


def stages(trainer: Trainer) -> tuple[list[dict], int]:
    """Time each stage on the first training view, with SH degree 3, and the whole step; a row each, and the instances."""
    device, parts = trainer.device, step_parts(trainer)
    camera, target, rule = parts.camera, parts.target, RULES[parts.rule]
    size = {"width": camera.width, "height": camera.height}
    inputs = [*parts.parameters.values(), camera.viewmat[None], camera.K[None]]
    background = parts.background[None]

    def run_project():
        return project(*inputs, **size, degree=3, rule=rule)

    projected, counts = run_project()
    tiles = bin_tiles(projected, counts, **size, rule=rule)
    leaf = projected.detach().requires_grad_()
    rgb = blend(leaf, tiles, background, **size, rule=rule)[0][0]
    image = rgb.detach().requires_grad_()
    v_projected, v_rgb = torch.rand_like(projected), torch.rand_like(rgb)

    def backward_of(outputs, sources, upstream=None):
        return lambda: torch.autograd.grad(outputs, sources, upstream, retain_graph=True)

    value = photometric_loss(image, target, None)
    result = {
        "project forward": measure(run_project, device),
        "tiles": measure(lambda: bin_tiles(projected, counts, **size, rule=rule), device),
        "blend forward": measure(lambda: blend(leaf, tiles, background, **size, rule=rule), device),
        "loss forward": measure(lambda: photometric_loss(image, target, None), device),
        "loss backward": measure(backward_of(value, [image]), device),
        "blend backward": measure(backward_of(rgb, [leaf], v_rgb), device),
        "project backward": measure(backward_of(projected, list(parts.parameters.values()), v_projected), device),
        "adam": measure(parts.optimize, device),
        "whole step": measure(lambda: one_step(trainer), device),
    }
    return [{"stage": name} | row for name, row in result.items()], len(tiles.slots)


def main() -> None:
    """Parse, measure, print a table, and write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene")
    parser.add_argument("--split", default="llff:3")
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--gaussians", type=int, default=100_000)
    parser.add_argument("--warm-steps", type=int, default=300, help="steps of fitting before anything is timed")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--out", type=Path)
    a = parser.parse_args()
    device, where = choose_device(a.device)
    scene = load_scene(a.scene, downscale=a.downscale)
    views = [scene.view(name) for name in split_views(scene, a.split).train]
    config = FitConfig(steps=100_000, init=InitConfig(source="random", random_count=a.gaussians))
    trainer = make_trainer(views, scene.points, config, device)
    for _ in range(a.warm_steps):
        one_step(trainer)
    rows, instances = stages(trainer)
    count = len(trainer.gaussians)
    print(f"{a.scene} {views[0].camera.width} x {views[0].camera.height} px, {count:,} Gaussians, {where}")
    for row in rows:
        print(f"  {row['stage']:<18}" + "  ".join(f"{k} {v}" for k, v in row.items() if k != "stage"))
    what = f"one training step on {Path(a.scene).name}, stage by stage"
    result_file.write(a.out, result_file.result(what, device, rows, gaussians=count, instances=instances))


if __name__ == "__main__":
    main()
