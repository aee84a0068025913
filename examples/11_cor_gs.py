"""A published baseline as a plug-in: CoR-GS (Zhang et al., ECCV 2024, arXiv 2405.12110), written from its formulas.

    python examples/11_cor_gs.py path/to/scene --split llff:3 --out cor_gs.png
    warpgs fit path/to/scene --out run --preset 3dgs --strategy examples/11_cor_gs.py:CorGS

Two models are trained on the same views. Gaussians without a neighbour in the other model are removed (co-pruning). Both models
are rendered from random cameras near the training cameras, and a loss compares the renders (co-regularisation). The class
`CorGS` is the whole baseline, and docs/add-a-baseline.md explains it. Prints the held-out PSNR of 3DGS and of CoR-GS, and
writes both renders.
"""

import argparse
import dataclasses
import tempfile
from collections.abc import Hashable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import warpgs
from warpgs.train import (
    CloneSplit,
    DensityUpdate,
    GradientGrowth,
    OptimizerConfig,
    StrategyContext,
    Table,
    TrainingView,
    captured_renderer,
    eager_renderer,
    most_instances,
    photometric_loss,
    register_strategy,
    state_schema,
)

import numpy as np
import torch
from PIL import Image

SSIM_WEIGHT = 0.2
"""Weight of SSIM in every photometric loss, as in 3DGS."""
CHUNK = 2**24
"""Largest number of distances that are in memory at the same time."""
SPARE, MIN_INSTANCES = 2, 100_000
"""Capacity for (Gaussian, tile) instances of a captured render: `SPARE` times the most instances of a training view, plus
`MIN_INSTANCES`."""
OF_TWIN = {"twin": state_schema(GradientGrowth.STATE)}
"""Schema of the second model in a checkpoint, without its tensors."""


@dataclass(frozen=True)
class CorConfig:
    """Settings of the strategy."""

    weight: float = 1.0
    """Weight of the loss between both models' renders from a random camera."""
    every: int = 500
    """Steps between two co-prunings."""
    distance: float = 1.0
    """Largest distance to the nearest Gaussian of the other model, as a fraction of the scene's extent. Gaussians farther away
    are removed."""
    noise: float = 0.3
    """Standard deviation of the noise of a random camera's position, as a fraction of the distance to the nearest camera."""


def nearest(points: torch.Tensor, others: torch.Tensor) -> torch.Tensor:
    """Return the distance of each point [N, 3] to the nearest of others [M, 3], shape [N]."""
    rows = max(1, CHUNK // max(1, len(others)))
    return torch.cat(
        [torch.cdist(part, others, compute_mode="donot_use_mm_for_euclid_dist").amin(1) for part in points.split(rows)]
    )


def random_cameras(views: list[TrainingView], noise: float, count: int, generator: torch.Generator) -> torch.Tensor:
    """Return the view matrices (camera_from_world) of random cameras, float64, shape [count, 4, 4].

    Each random camera has the position of a training camera plus noise, and the mean orientation of this training camera and
    its nearest neighbour.
    """
    poses = torch.stack([torch.as_tensor(v.camera.viewmat) for v in views]).double().cpu()
    rotations = poses[:, :3, :3]
    centers = -(rotations.mT @ poses[:, :3, 3:]).squeeze(-1)
    apart = torch.cdist(centers, centers).fill_diagonal_(torch.inf)
    u, _, vt = torch.linalg.svd((rotations + rotations[apart.argmin(1)]) / 2)
    sign = torch.ones(len(views), 3, dtype=torch.float64)
    sign[:, 2] = torch.det(u @ vt)
    middle = (u * sign[:, None]) @ vt  # the rotations nearest to the means of the matrices
    chosen = torch.randint(len(views), (count,), generator=generator)
    moved = noise * apart.amin(1)[chosen, None] * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    viewmats = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    viewmats[:, :3, :3] = middle[chosen]
    viewmats[:, :3, 3] = -(middle[chosen] @ (centers[chosen] + moved)[..., None]).squeeze(-1)
    return viewmats


@register_strategy("cor_gs")
class CorGS(CloneSplit):
    """Two models of one scene, pruned and regularised where they disagree; the first model is the result.

    A step is captured as a CUDA graph. So all random numbers are sampled before the first step, and each step looks up its own.
    """

    Config = CorConfig
    STATE = staticmethod(state_schema(GradientGrowth.STATE | OF_TWIN))

    def setup(self) -> None:
        """Copy the first model to the second, and sample the random cameras and the order of views.

        Raises:
            UsageError: The training views are fewer than two, of several sizes, transparent or distorted.
        """
        context, views = self.context, self.context.views
        shapes = {v.image.shape for v in views}
        if len(views) < 2 or len(shapes) > 1 or any(v.alpha is not None or v.camera.distortion is not None for v in views):
            raise warpgs.UsageError(
                "cor_gs needs at least two opaque training views of one size, without lens distortion; use another --strategy"
            )
        table = Table.of_gaussians(context.gaussians, GradientGrowth.columns())
        self.twin: StrategyContext = dataclasses.replace(context, table=table)
        self.twin_growth = GradientGrowth(self.twin)
        device, steps = context.device, context.steps
        cameras = random_cameras(views, self.config.noise, steps, context.generator)
        orders = [torch.randperm(len(views), generator=context.generator) for _ in range(-(-steps // len(views)))]
        optimizer = context.settings[OptimizerConfig]
        rows = [
            table.lr_row(optimizer.lrs(context.phases.progress(step), context.extent), step, optimizer.head_lrs)
            for step in range(1, steps + 1)
        ]
        self.cameras, self.lrs = cameras.float().to(device), torch.tensor(rows, device=device)
        self.order, self.taken = torch.cat(orders)[:steps].to(device), torch.zeros(1, dtype=torch.int64, device=device)
        self.viewmats, self.Ks = (torch.stack([getattr(v.camera, n) for v in views]) for n in ("viewmat", "K"))
        self.images = torch.stack([v.image for v in views])
        masked = any(v.mask is not None for v in views)
        self.masks = (
            torch.stack([torch.ones_like(v.image[..., 0]) if v.mask is None else v.mask for v in views]) if masked else None
        )
        self.overflow = torch.zeros(1, dtype=torch.int32, device=device)
        self._measure()

    @torch.no_grad()
    def _measure(self) -> None:
        """Choose the renderer: on CUDA, one with a fixed capacity for (Gaussian, tile) pairs, for capture as a graph."""
        context, options = self.context, self.context.render_options()
        self.render = eager_renderer(options, None)
        if context.device.type == "cuda":
            cameras = [v.camera for v in context.views]
            most = max(most_instances(t.gaussians, cameras, options) for t in (context.table, self.twin.table))
            self.render = captured_renderer(options, SPARE * most + MIN_INSTANCES, self.overflow)

    def _image(self, table: Table, viewmat: torch.Tensor, K: torch.Tensor) -> warpgs.Render:
        """Return the render of the camera with view matrix [1, 4, 4] and intrinsics [1, 3, 3]; its colours are [H, W, 3]."""
        camera = dataclasses.replace(self.context.views[0].camera, viewmat=viewmat, K=K)
        return self.render(table.gaussians, camera, table.gaussians.sh_degree, None, None)

    def regularisation(self, phase: Hashable, gaussians: warpgs.Gaussians) -> torch.Tensor:
        """Return the first model's loss term, shape [], and compute the gradients of the second model."""
        twin, weight, step = self.twin.table, self.config.weight, self.taken
        self.overflow.zero_()
        view = self.order.index_select(0, step)
        viewmat, K, own_viewmat = (
            self.cameras.index_select(0, step),
            *(t.index_select(0, view) for t in (self.Ks, self.viewmats)),
        )
        first, second = (self._image(t, viewmat, K).rgb for t in (self.context.table, twin))
        term = weight * photometric_loss(first, second.detach(), None, SSIM_WEIGHT)

        found = self._image(twin, own_viewmat, K)
        image = self.images.index_select(0, view)[0]
        mask = None if self.masks is None else self.masks.index_select(0, view)[0]
        loss = photometric_loss(found.rgb, image, mask, SSIM_WEIGHT)
        loss = loss + weight * photometric_loss(second, first.detach(), None, SSIM_WEIGHT)
        *self.gradients_of_twin, v_projected = torch.autograd.grad(
            loss, [*twin.params.values(), found.projected], materialize_grads=True
        )
        if phase:
            size = (image.shape[1], image.shape[0])
            self.statistics_of_twin = self.twin_growth.statistics(v_projected, found.visible, size)
        ended: torch.Tensor = torch.where(self.overflow[0] != 0, torch.nan, 0 * loss.detach())  # NaN ends the fit
        total: torch.Tensor = term + ended
        return total

    def after_step(self, phase: Hashable, settings: torch.Tensor, going: torch.Tensor) -> None:
        """Update the second model if ``going`` [1] is True; ``settings`` [7] are not read."""
        twin = self.twin.table
        gradients = dict(zip(twin.params, self.gradients_of_twin))
        twin.adam_step(gradients, self.lrs.index_select(0, self.taken)[0], (~going).to(torch.int32))
        if phase:
            for name, value in self.statistics_of_twin.items():
                twin.columns[name] += torch.where(going, value, 0)
        self.taken += going.to(torch.int64)

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
        self._measure()

    def _matched(self) -> list[torch.Tensor]:
        """Return which Gaussians of each model have a neighbour in the other, bool, shape [N]; all if no Gaussian has one."""
        means = [t.params["means"].detach() for t in (self.context.table, self.twin.table)]
        most = self.config.distance * self.context.extent
        near = [nearest(a, b) <= most for a, b in (means, means[::-1])]
        return [m if bool(m.any()) else ~m for m in near]

    def state(self) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
        """Return the second model's tensors [N, ...], the number of its steps [1], and the state of both `GradientGrowth`."""
        tensors, plain = super().state()
        twin = {f"twin.{n}": t for n, t in self.twin.table.state().items()}
        return tensors | twin | {"taken": self.taken}, plain | {"twin": self.twin_growth.state()}

    def load(self, tensors: Mapping[str, torch.Tensor], plain: dict[str, Any]) -> None:
        """Load what `state` returned."""
        super().load(tensors, plain)
        self.twin.table.load({n.removeprefix("twin."): t for n, t in tensors.items() if n.startswith("twin.")})
        self.twin_growth.load(plain["twin"])
        self.taken.copy_(tensors["taken"])
        self._measure()


def _kept(table: Table, rows: torch.Tensor) -> DensityUpdate:
    """Return the update that keeps only the Gaussians that are True in ``rows``, bool [N]."""
    nothing = {n: t.detach()[:0] for n, t in table.params.items()}
    return DensityUpdate(rows.nonzero().squeeze(1), nothing, torch.empty(0, dtype=torch.int64, device=rows.device))


def main(arguments: list[str] | None = None) -> float:
    """Run the example; return the gain in held-out PSNR over 3DGS [dB]."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, nargs="?", help="scene folder; default: a synthetic scene")
    parser.add_argument("--split", default="llff:3", help="training and held-out views, as in warpgs fit")
    parser.add_argument("--out", type=Path, default=Path("cor_gs.png"), help="PNG to write")
    parser.add_argument("--steps", type=int, default=1000, help="optimisation steps of each fit")
    parser.add_argument("--width", type=int, default=96, help="width of the synthetic images [px]")
    a = parser.parse_args(arguments)

    base = dataclasses.replace(warpgs.PRESETS["3dgs"], steps=a.steps, sh_degree=0)
    with tempfile.TemporaryDirectory() as folder:
        if a.scene is None:
            a.scene = Path(folder) / "scene"
            a.split = warpgs.write_demo(a.scene, views=9, width=a.width, height=3 * a.width // 4)
        scene = warpgs.load_scene(a.scene)
        settings = {"split": a.split, "verbose": False}
        results = [warpgs.fit(scene, base, **settings), warpgs.fit(scene, base, strategy=CorGS, **settings)]

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
