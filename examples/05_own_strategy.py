"""A density strategy of your own: it adds and removes Gaussians during a fit.

    python examples/05_own_strategy.py path/to/scene --out sprout.png
    warpgs fit path/to/scene --out run --strategy examples/05_own_strategy.py:Sprout --sprout.growth 0.2

The class `Sprout` is the whole strategy. The second command loads the class from this file, with its settings as flags. The
first command fits a scene with the strategy and without growth. It prints the number of Gaussians and the training PSNR of both
fits, and writes a training image and both renders of it side by side.
"""

import argparse
import dataclasses
import tempfile
from collections.abc import Hashable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import warpgs
from warpgs.train import Column, DensityUpdate, InitConfig, register_strategy

import numpy as np
import torch
from PIL import Image


@dataclass(frozen=True)
class SproutConfig:
    """Settings of the strategy."""

    every: int = 10
    """Steps between two changes of the set of Gaussians."""
    growth: float = 0.1
    """Gaussians added at a time, as a fraction of their current number."""
    min_opacity: float = 0.02
    """Gaussians below this opacity are removed."""


@register_strategy("sprout")
class Sprout(warpgs.Strategy):
    """Adds Gaussians next to those with the largest gradients of projected means; removes transparent Gaussians."""

    Config = SproutConfig

    def columns(self) -> Mapping[str, Column]:
        """Return the only column of the strategy: the sum of each Gaussian's gradient norms since the last update."""
        return {"pull": Column(0.0, inherited=False)}

    def statistics(
        self, phase: Hashable, v_projected: torch.Tensor, visible: torch.Tensor, size: tuple[int, int]
    ) -> Mapping[str, torch.Tensor]:
        """Return the gradient norms of the projected means, shape [N]; the trainer adds them to the column `pull`.

        ``v_projected`` [1, N, 12] is the gradient with respect to the projected Gaussians; its first two columns belong to the
        means.

        On CUDA the whole step is captured as a graph, so this method may only use tensors.
        """
        norms = v_projected[0, :, :2].norm(dim=1)
        return {"pull": torch.where(visible[0], norms, 0)}

    def due(self, step: int) -> bool:
        """Return whether Gaussians are added or removed after a step; never in the last fifth of the fit."""
        return step % self.config.every == 0 and step <= 0.8 * self.context.steps

    def update(self, step: int) -> Iterator[DensityUpdate]:
        """Add and remove Gaussians."""
        t = self.context
        g, pull = t.gaussians, t.table.columns["pull"]
        count = max(0, min(int(self.config.growth * len(g)), t.capacity - len(g)))
        parents = pull.topk(count).indices
        added = {name: tensor[parents] for name, tensor in g.tensors().items()}
        noise = torch.randn(count, 3, generator=t.generator).to(t.device)  # repeatable: the fit's generator
        added["means"] = added["means"] + 0.5 * noise * added["log_scales"].exp()
        opacities = g.logit_opacities.sigmoid()
        keep = torch.nonzero(opacities >= min(self.config.min_opacity, float(opacities.max()))).squeeze(1)
        yield DensityUpdate(keep, added, parents)
        t.table.columns["pull"].zero_()


def main(arguments: list[str] | None = None) -> float:
    """Run the example; return the gain in training PSNR over a fit that never grows [dB]."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, nargs="?", help="scene folder; default: a synthetic scene")
    parser.add_argument("--out", type=Path, default=Path("sprout.png"), help="PNG to write")
    parser.add_argument("--steps", type=int, default=300, help="optimisation steps of each fit")
    parser.add_argument("--start", type=int, default=400, help="Gaussians at the start")
    parser.add_argument("--width", type=int, default=96, help="width of the synthetic images [px]")
    a = parser.parse_args(arguments)

    base = warpgs.FitConfig(
        preset="sprout",
        steps=a.steps,
        strategy="sprout",
        init=InitConfig(source="random", random_count=a.start),
        sh_degree=0,
    )
    configs = [dataclasses.replace(base, strategy_config=SproutConfig(growth=growth)) for growth in (0.0, 0.1)]
    with tempfile.TemporaryDirectory() as folder:
        split = "every:8"
        if a.scene is None:
            a.scene = Path(folder) / "scene"
            split = warpgs.write_demo(a.scene, views=9, width=a.width, height=3 * a.width // 4)
        scene = warpgs.load_scene(a.scene)
        results = [warpgs.fit(scene, config, split=split, verbose=False) for config in configs]

    view = scene.view(results[0].train[0])
    row = [view.image]
    for name, result in zip(("no growth", "Sprout"), results):
        with torch.no_grad():
            row.append(warpgs.rasterize(result.gaussians(), view.camera, result.options()).rgb.clamp(0, 1).cpu().numpy())
        scores = result.metrics
        print(f"{name}: {len(result.gaussians()):,} Gaussians, training PSNR {scores['train']['psnr']:.2f} dB")
    Image.fromarray((np.concatenate(row, 1) * 255).round().astype(np.uint8)).save(a.out)
    print(f"image, no growth and Sprout in {a.out}")
    return float(results[1].metrics["train"]["psnr"] - results[0].metrics["train"]["psnr"])


if __name__ == "__main__":
    main()
