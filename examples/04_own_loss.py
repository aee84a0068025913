"""A loss term of your own: depth that is smooth where the image is smooth.

    python examples/04_own_loss.py path/to/scene --out smooth.png
    warpgs fit path/to/scene --out run --loss-terms examples/04_own_loss.py:DepthSmoothness --depth-smoothness.weight 0.5

The class `DepthSmoothness` is the whole term. The second command loads the class from this file, and makes the setting of the
class a flag. The first command fits a scene with and without the term. It prints roughness and held-out PSNR of both fits, and
writes the depth maps of a view.
"""

import argparse
import dataclasses
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import warpgs
from warpgs.train import LossInputs, register_loss_term

import numpy as np
import torch
from PIL import Image


def roughness(depth: torch.Tensor, alpha: torch.Tensor, image: torch.Tensor) -> torch.Tensor:
    """Return the mean absolute difference of inverse depth between neighbours, with less weight at colour edges, shape [].

    The means along x and y are added. A pair of neighbours counts if both have alpha above 0.5. Inverse depth is divided by its
    mean, so that the unit of length does not matter (Godard et al. 2017, eq. 5). ``depth`` and ``alpha`` have shape [H, W],
    ``image`` [H, W, 3].
    """
    covered = alpha > 0.5
    inverse = torch.where(covered, 1 / torch.where(covered, depth, 1), 0)
    inverse = inverse / (inverse.detach().sum() / covered.sum().clamp_min(1)).clamp_min(1e-12)
    total = depth.new_zeros(())
    for axis in (0, 1):
        size = depth.shape[axis] - 1
        (a, b), (ca, cb), (ia, ib) = ((t.narrow(axis, 0, size), t.narrow(axis, 1, size)) for t in (inverse, covered, image))
        weight = torch.exp(-10 * (ia - ib).abs().mean(-1)) * (ca & cb)
        total = total + ((a - b).abs() * weight).sum() / weight.sum().clamp_min(1)
    return total


@register_loss_term("depth_smoothness")
@dataclass(frozen=True)
class DepthSmoothness(warpgs.LossTerm):
    """Edge-aware smoothness of the rendered inverse depth."""

    needs_outputs: ClassVar[tuple[str, ...]] = ("alpha", "depth")
    weight: float = 0.5
    """Weight of the term."""

    def __call__(self, inputs: LossInputs) -> torch.Tensor:
        """Return the weighted roughness of the step's view."""
        return self.weight * roughness(inputs.outputs["depth"], inputs.outputs["alpha"], inputs.target.image)


def main(arguments: list[str] | None = None) -> float:
    """Run the example; return the roughness with the term as a fraction of the roughness without it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, nargs="?", help="scene folder; default: a synthetic scene")
    parser.add_argument("--out", type=Path, default=Path("smooth.png"), help="PNG to write")
    parser.add_argument("--steps", type=int, default=300, help="optimisation steps of each fit")
    parser.add_argument("--weight", type=float, default=0.5, help="weight of the term")
    parser.add_argument("--width", type=int, default=96, help="width of the synthetic images [px]")
    a = parser.parse_args(arguments)

    with tempfile.TemporaryDirectory() as folder:
        split = "every:8"
        if a.scene is None:
            a.scene = Path(folder) / "scene"
            split = warpgs.write_demo(a.scene, views=9, width=a.width, height=3 * a.width // 4)
        scene = warpgs.load_scene(a.scene)
        plain = dataclasses.replace(warpgs.PRESETS["quick"], steps=a.steps)
        smooth = dataclasses.replace(plain, loss_terms=(DepthSmoothness(a.weight),))
        results = [warpgs.fit(scene, config, split=split, verbose=False) for config in (plain, smooth)]

    view, maps, found = scene.view(results[0].test[0]), [], []
    for name, result in zip(("without", "with"), results):
        with torch.no_grad():
            render = warpgs.rasterize(result.gaussians(), view.camera, result.options())
        render_depth, alpha = render.depth.cpu(), render.alpha.cpu()
        found.append(float(roughness(render_depth, alpha, torch.from_numpy(view.image))))
        maps.append(torch.where(alpha > 0.5, 1 / render_depth.clamp_min(1e-6), 0).numpy())
        print(f"{name} the term: roughness {found[-1]:.4f}, held-out PSNR {result.metrics['test']['psnr']:.2f} dB")
    row = np.concatenate([m / max(m.max() for m in maps) for m in maps], 1)
    Image.fromarray((row * 255).round().astype(np.uint8)).save(a.out)
    print(f"inverse depth of {view.name}, without and with, in {a.out}")
    return found[1] / found[0]


if __name__ == "__main__":
    main()
