"""A published baseline as a plug-in: CoR-GS (Zhang et al., ECCV 2024, arXiv 2405.12110), written from its formulas.

    python examples/11_cor_gs.py path/to/scene --split llff:3 --out cor_gs.png
    warpgs fit path/to/scene --out run --preset 3dgs --strategy examples/11_cor_gs.py:CorGS --no-cuda-graph

Two models are trained on the same views. Gaussians without a neighbour in the other model are removed (co-pruning), and both
renders of a random camera near the training cameras are drawn towards each other (co-regularisation). The class below is the
whole baseline, and docs/add-a-baseline.md explains it. Prints the held-out PSNR of 3DGS and of CoR-GS; writes both renders.
"""

import argparse
import dataclasses
import tempfile
from collections.abc import Hashable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import warpgs
from warpgs import schema
from warpgs.errors import UsageError
from warpgs.pipeline.model.table import DensityUpdate, Table
from warpgs.pipeline.train.context import StrategyContext
from warpgs.pipeline.train.loss_terms.photometric import photometric_loss
from warpgs.pipeline.train.presets import PRESETS
from warpgs.pipeline.train.schedule import OptimizerConfig
from warpgs.pipeline.train.strategies.base import register
from warpgs.pipeline.train.strategies.clone_split import CloneSplit
from warpgs.pipeline.train.strategies.gradient_growth import GradientGrowth
from warpgs.pipeline.train.views import TrainingView

import numpy as np
import torch
from PIL import Image

SSIM_WEIGHT = 0.2
"""Weight of SSIM in every photometric loss, as in 3DGS."""
CHUNK = 2**24
"""Distances that are held at a time."""
OF_TWIN = {"twin": schema.fields(GradientGrowth.STATE), "order": schema.items(schema.whole(0))}
"""Schema of what a checkpoint holds of the second model beside its tensors."""


@dataclass(frozen=True)
class CorConfig:
    """Settings of the strategy."""

    weight: float = 1.0
    """Weight of the term between the renders of a random camera."""
    every: int = 500
    """Steps between two co-prunings."""
    distance: float = 1.0
    """Distance to the nearest Gaussian of the other model, over the scene's extent, above which a Gaussian is removed."""
    noise: float = 0.3
    """Standard deviation of a random camera's position, over the distance of two neighbouring cameras."""


def nearest(points: torch.Tensor, others: torch.Tensor) -> torch.Tensor:
    """Return the distance of each point [N, 3] to the nearest of others [M, 3], shape [N]."""
    rows = max(1, CHUNK // max(1, len(others)))
    return torch.cat(
        [torch.cdist(part, others, compute_mode="donot_use_mm_for_euclid_dist").amin(1) for part in points.split(rows)]
    )


class Pseudo:
    """Random cameras: the position of a training camera with noise, the orientation between it and its nearest neighbour."""

    def __init__(self, views: list[TrainingView], noise: float):
        """Keep centers and rotations of the training cameras."""
        self.cameras = [v.camera for v in views]
        poses = torch.stack([c.viewmat for c in self.cameras]).double().cpu()
        self.rotations = poses[:, :3, :3]
        self.centers = -(self.rotations.mT @ poses[:, :3, 3:]).squeeze(-1)
        apart = torch.cdist(self.centers, self.centers) + torch.diag(torch.full((len(views),), torch.inf, dtype=torch.float64))
        self.spread, self.neighbor = noise * apart.amin(1), apart.argmin(1)

    def draw(self, generator: torch.Generator) -> warpgs.Camera:
        """Return a random camera, with the size and the intrinsics of a training camera."""
        i = int(torch.randint(len(self.cameras), (1,), generator=generator))
        u, _, vt = torch.linalg.svd(self.rotations[[i, int(self.neighbor[i])]].mean(0))
        R = u @ torch.diag(torch.tensor([1.0, 1.0, float(torch.det(u @ vt))], dtype=torch.float64)) @ vt  # the nearest rotation
        center = self.centers[i] + self.spread[i] * torch.randn(3, generator=generator, dtype=torch.float64)
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[:3, :3], viewmat[:3, 3] = R, -R @ center
        given = self.cameras[i]
        return dataclasses.replace(given, viewmat=viewmat.to(given.K.dtype).to(given.K.device))


@register("cor_gs")
class CorGS(CloneSplit):
    """Two models of one scene, pruned and regularised where they disagree; the first of them is the result."""

    Config = CorConfig
    STATE = staticmethod(
        schema.fields(
            GradientGrowth.STATE | {"twin": schema.fields(GradientGrowth.STATE), "order": schema.items(schema.whole(0))}
        )
    )

    def setup(self) -> None:
        """Begin the second model with the Gaussians of the first."""
        context = self.context
        if len(context.views) < 2 or any(v.alpha is not None for v in context.views):
            raise UsageError("cor_gs needs at least two opaque training views; name more in --split, or another --strategy")
        table = Table.of_gaussians(context.gaussians, GradientGrowth.columns())
        self.twin: StrategyContext = dataclasses.replace(context, table=table)
        self.twin_growth = GradientGrowth(self.twin)
        self.pseudo, self.order = Pseudo(context.views, self.config.noise), list[int]()
        self.gradients_of_twin: list[torch.Tensor] = []

    def phase(self, step: int) -> Hashable:
        """Return whether gradients are gathered in a step, and its number."""
        return self.gradients.gathers(step), step

    def statistics(self, phase: Any, v_projected, visible, size):
        """Return statistics of gradients, [N] each; ``v_projected`` has shape [1, N, 12], ``visible`` [1, N]."""
        return super().statistics(phase[0], v_projected, visible, size)

    def _render(self, table: Table, camera: warpgs.Camera) -> tuple[warpgs.Render, torch.Tensor]:
        """Return the render of one camera, and its colours [H, W, 3]."""
        options = dataclasses.replace(self.context.render_options(), record=False)
        batch = dataclasses.replace(camera, viewmat=camera.viewmat[None], K=camera.K[None])
        found = warpgs.rasterize(table.gaussians, batch, options)
        return found, found.rgb.squeeze(0)

    def regularisation(self, phase: Any, gaussians: warpgs.Gaussians) -> torch.Tensor:
        """Return the first model's term, shape [], and find the gradients of the second model."""
        if self.context.device.type == "cuda" and torch.cuda.is_current_stream_capturing():
            raise UsageError("cor_gs changes two models in a step, which no CUDA graph holds; give --no-cuda-graph")
        twin, weight = self.twin.table, self.config.weight
        camera = self.pseudo.draw(self.context.generator)
        (_, first), (_, second) = (self._render(t, camera) for t in (self.context.table, twin))
        term = weight * photometric_loss(first, second.detach(), None, SSIM_WEIGHT)

        self.order = self.order or torch.randperm(len(self.context.views), generator=self.context.generator).tolist()
        view = self.context.views[self.order.pop()]
        found, rgb = self._render(twin, view.camera)
        loss = photometric_loss(rgb, view.image, view.mask, SSIM_WEIGHT)
        loss = loss + weight * photometric_loss(second, first.detach(), None, SSIM_WEIGHT)
        *self.gradients_of_twin, v_projected = torch.autograd.grad(
            loss, [*twin.params.values(), found.projected], materialize_grads=True
        )
        if phase[0]:
            size = (view.camera.width, view.camera.height)
            self.statistics_of_twin = self.twin_growth.statistics(v_projected, found.visible, size)
        return term

    def after_step(self, phase: Any, settings: torch.Tensor, going: torch.Tensor) -> None:
        """Update the second model."""
        step, twin = phase[1], self.twin.table
        optimizer = self.context.settings[OptimizerConfig]
        lrs = optimizer.lrs(self.context.phases.progress(step), self.context.extent, 0.0)
        rows = torch.tensor(twin.lr_row(lrs, step, optimizer.head_lrs), device=going.device)
        stop = (~going).to(torch.int32)
        twin.adam_step(dict(zip(twin.params, self.gradients_of_twin)), rows, stop)
        if phase[0]:
            for name, value in self.statistics_of_twin.items():
                twin.columns[name] += torch.where(going, value, 0)

    def prunes(self, step: int) -> bool:
        """Return whether the models are pruned by each other after a step."""
        return self.gradients.gathers(step) and step > self.gradients.config.start and step % self.config.every == 0

    def due(self, step: int) -> bool:
        """Return whether the set of Gaussians changes after a step."""
        return super().due(step) or self.prunes(step)

    def update(self, step: int) -> Iterator[DensityUpdate]:
        """Refine both models, then prune both by each other."""
        yield from super().update(step)
        self.twin.capacity = self.context.capacity
        if self.twin_growth.refines(step):
            for change in self.twin_growth.refine():
                self.twin.table.apply(change)
        if self.twin_growth.resets(step):
            self.twin_growth.reset_opacities()
        if self.prunes(step):
            ours, theirs = self._matched()
            self.twin.table.apply(_kept(self.twin.table, theirs))
            yield _kept(self.context.table, ours)

    def _matched(self) -> list[torch.Tensor]:
        """Return which Gaussians of each model have a neighbour in the other one, bool, shape [N]; all, where none has."""
        means = [t.params["means"].detach() for t in (self.context.table, self.twin.table)]
        most = self.config.distance * self.context.extent
        near = [nearest(a, b) <= most for a, b in (means, means[::-1])]
        return [m if bool(m.any()) else ~m for m in near]

    def state(self) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
        """Return the second model, [N, ...] each, and what both growths and the order of views need."""
        tensors, plain = super().state()
        twin = {f"twin.{n}": t for n, t in self.twin.table.state().items()}
        return tensors | twin, plain | {"twin": self.twin_growth.state(), "order": self.order}

    def load(self, tensors: Mapping[str, torch.Tensor], plain: dict[str, Any]) -> None:
        """Load what `state` returned."""
        super().load(tensors, plain)
        self.twin.table.load({n.removeprefix("twin."): t for n, t in tensors.items() if n.startswith("twin.")})
        self.twin_growth.load(plain["twin"])
        self.order = list(plain["order"])


def _kept(table: Table, rows: torch.Tensor) -> DensityUpdate:
    """Return the change that keeps the Gaussians whose row, bool [N], is True."""
    nothing = {n: t.detach()[:0] for n, t in table.params.items()}
    return DensityUpdate(rows.nonzero().squeeze(1), nothing, torch.empty(0, dtype=torch.int64, device=rows.device))


def main(arguments: list[str] | None = None) -> float:
    """Run the example; returns the gain in held-out PSNR over 3DGS [dB]."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, nargs="?", help="scene folder; a synthetic one where not given")
    parser.add_argument("--split", default="llff:3", help="as in warpgs fit")
    parser.add_argument("--out", type=Path, default=Path("cor_gs.png"), help="PNG to write")
    parser.add_argument("--steps", type=int, default=1000, help="optimisation steps of each fit")
    parser.add_argument("--width", type=int, default=96, help="width of the synthetic images [px]")
    a = parser.parse_args(arguments)

    base = dataclasses.replace(PRESETS["3dgs"], steps=a.steps, sh_degree=0, cuda_graph=False)
    with tempfile.TemporaryDirectory() as folder:
        if a.scene is None:
            from warpgs.synthetic.demo import write_demo

            a.scene = Path(folder) / "scene"
            a.split = write_demo(a.scene, views=9, width=a.width, height=3 * a.width // 4)
        scene = warpgs.load_scene(a.scene)
        configs = [base, dataclasses.replace(base, strategy=CorGS)]
        results = [warpgs.fit(scene, config, split=a.split, verbose=False) for config in configs]

    view, row = scene.view(results[0].test[0]), []
    for name, result in zip(("3DGS", "CoR-GS"), results):
        with torch.no_grad():
            row.append(warpgs.rasterize(result.gaussians(), view.camera, result.options()).rgb.clamp(0, 1).cpu().numpy())
        print(f"{name}: {len(result.gaussians()):,} Gaussians, held-out PSNR {result.metrics['test']['psnr']:.2f} dB")
    Image.fromarray((np.concatenate([*row, view.image], 1) * 255).round().astype(np.uint8)).save(a.out)
    print(f"renders of 3DGS and CoR-GS, and the photograph, in {a.out}")
    return float(results[1].metrics["test"]["psnr"] - results[0].metrics["test"]["psnr"])


if __name__ == "__main__":
    main()
