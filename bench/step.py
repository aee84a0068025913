"""Time of one training step, stage by stage, on a real or synthetic scene.

usage: python -m bench.step SCENE [--split llff:3] [--downscale 1] [--gaussians 100000] [--device auto] [--out FILE.json]
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import torch

from bench.harness import measure
from warpgs import load_scene
from warpgs.constants import RULES
from warpgs.io.splits import split_views
from warpgs.kernels.blend import blend
from warpgs.kernels.project import project
from warpgs.kernels.tiles import bin_tiles
from warpgs.pipeline.model.init import InitConfig
from warpgs.pipeline.runs.folder import choose_device
from warpgs.pipeline.train.config import FitConfig
from warpgs.pipeline.train.loss import LossConfig, photometric_loss
from warpgs.pipeline.train.trainer import Trainer, train_views


def stages(fit: Trainer) -> dict[str, dict[str, float]]:
    """Time each stage on the first training view, with SH degree 3, and the whole step."""
    device, rule = fit.device, RULES[fit.config.rule]
    camera, target = fit.views[0].camera, fit.views[0].image
    size = {"width": camera.width, "height": camera.height}
    inputs = [*fit.optimizer.gaussians.tensors().values(), camera.viewmat[None], camera.K[None]]
    background = fit.background[None]

    def run_project():
        return project(*inputs, **size, degree=3, rule=rule)

    projected, counts = run_project()
    tiles = bin_tiles(projected, counts, **size, rule=rule)
    leaf = projected.detach().requires_grad_()
    rgb = blend(leaf, tiles, background, **size, rule=rule)[0][0]
    image = rgb.detach().requires_grad_()
    v_projected, v_rgb = torch.rand_like(projected), torch.rand_like(rgb)
    loss = LossConfig()

    def backward_of(outputs, sources, upstream=None):
        return lambda: torch.autograd.grad(outputs, sources, upstream, retain_graph=True)

    value = photometric_loss(image, target, None, loss)
    params = list(fit.optimizer.params.values())

    def optimize():
        for p in params:
            p.grad = torch.zeros_like(p)
        fit.optimizer.step(0.5)

    result = {
        "project forward": measure(run_project, device),
        "tiles": measure(lambda: bin_tiles(projected, counts, **size, rule=rule), device),
        "blend forward": measure(lambda: blend(leaf, tiles, background, **size, rule=rule), device),
        "loss forward": measure(lambda: photometric_loss(image, target, None, loss), device),
        "loss backward": measure(backward_of(value, [image]), device),
        "blend backward": measure(backward_of(rgb, [leaf], v_rgb), device),
        "project backward": measure(backward_of(projected, params, v_projected), device),
        "adam": measure(optimize, device),
    }
    result["whole step"] = measure(fit.advance, device)
    result["instances"] = {"count": len(tiles.slots)}
    return result


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
    views = train_views(scene, split_views(scene, a.split).train)
    config = FitConfig(steps=100_000, init=InitConfig(source="random", random_count=a.gaussians))
    fit = Trainer(views, scene.points, config, device)
    for _ in range(a.warm_steps):
        fit.advance()
    table = stages(fit)
    print(f"{a.scene} {views[0].camera.width} x {views[0].camera.height} px, {len(fit.gaussians):,} Gaussians, {where}")
    for name, row in table.items():
        print(f"  {name:<18}" + "  ".join(f"{k} {v}" for k, v in row.items()))
    if a.out:
        record = {"device": where, "gaussians": len(fit.gaussians), "torch": torch.__version__, "stages": table}
        a.out.write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
