"""Time of one training step, stage by stage, on a real or synthetic scene.

--warm-steps are taken before anything is timed.
"""

from __future__ import annotations

from pathlib import Path

import torch

from bench.lib import result_file
from bench.lib.arguments import SCENE, parse
from bench.lib.kernel_calls import bin_tiles, blend, project
from bench.lib.tables import named
from bench.lib.timing import measure
from bench.lib.training import Trainer, make_trainer, one_step, step_parts
from warpgs import load_scene
from warpgs.constants import RULES
from warpgs.io.load import split_views
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.run.request import choose_device
from warpgs.pipeline.train.loss import photometric_loss
from warpgs.pipeline.train.settings import FitConfig


def stages(trainer: Trainer) -> tuple[list[dict], int]:
    """Time each stage on the first training view, with SH degree 3, and the whole step; a row each, and the instances."""
    device, (view, parameters, optimize) = trainer.device, step_parts(trainer)
    camera, target, rule = view.camera, view.image, RULES[trainer.config.rule]
    size = {"width": camera.width, "height": camera.height}
    inputs = [*parameters.values(), camera.viewmat[None], camera.K[None]]
    background = trainer.background[None]

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
        "project backward": measure(backward_of(projected, list(parameters.values()), v_projected), device),
        "adam": measure(optimize, device),
        "whole step": measure(lambda: one_step(trainer), device),
    }
    return [{"stage": name} | row for name, row in result.items()], len(tiles.slots)


def main() -> None:
    """Measure, print, write."""
    a = parse(
        __doc__, None, SCENE, split="llff:3", downscale=1, gaussians=100_000, warm_steps=300, device="auto", out=Path,
    )  # fmt: skip
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
    print(*map(named, rows), sep="\n")
    what = f"one training step on {a.scene.name}, stage by stage"
    result_file.keep(a.out, what, device, rows, gaussians=count, instances=instances)


if __name__ == "__main__":
    main()
