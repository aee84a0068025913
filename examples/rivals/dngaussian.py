"""DNGaussian (Li et al., CVPR 2024, arXiv 2403.06912) as a plug-in: hard and soft depth, normalised in patches.

    warpgs fit path/to/scene --out run --preset examples/rivals/dngaussian.py:dngaussian --split llff:3

Hard depth is rendered with one opacity, 0.95, for all Gaussians, and moves only their means; soft depth is rendered as it is,
and changes only opacities. Both are compared with the depth map of a training view: that of `--depths` or `--depth-model`, else
of the depth sweep. Maps are normalised in patches by the image's standard deviation, and with weight 0.1 by the patch's own.
Maps are inverse depths here, as networks give them.
Constants are those of the authors' `scripts/run_llff.sh` and `train_llff.py` (Fictionarry/DNGaussian, 14c3c6a4, 3b7feac7); that
the paper has the same ones is not confirmed.
Missing here: the neural colour field, patches of a random size (5 to 17 px), own Adam steps of both terms, penalties on shapes
and opacities, smooth depth after 3000 steps, and the learning rates for a start from random points.
"""

import dataclasses
import math
from collections.abc import Hashable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import warpgs
from warpgs.train import (
    CloneSplit,
    DensityUpdate,
    captured_renderer,
    eager_renderer,
    most_instances,
    register_strategy,
    total,
)

import torch

SPARE, MIN_INSTANCES = 3, 100_000
"""Capacity for (Gaussian, tile) instances of a captured render: `SPARE` times the most instances of hard depth in a training
view, plus `MIN_INSTANCES`. Opaque Gaussians touch more tiles."""
MIN_ALPHA = 0.5
"""Opacity above which a pixel has a depth."""
SMALLEST = 1e-3
"""Standard deviation that is added to every other one; maps have values around 1."""


@dataclass(frozen=True)
class DnConfig:
    """Settings of the strategy."""

    weight: float = 1.0
    """Weight of the depth terms."""
    whole: float = 1.0
    """Weight of patches that are normalised by the image's standard deviation (Global-Local Depth Normalization)."""
    local: float = 0.1
    """Weight of patches that are normalised by their own standard deviation (Global-Local Depth Normalization)."""
    opacity: float = 0.95
    """Opacity of all Gaussians in hard depth (tau; Hard Depth Regularization)."""
    patch: int = 11
    """Side of a patch [px]: the middle of 5 to 17."""
    tolerance: float = 0.00025
    """Difference of normalised maps up to which a pixel has no loss."""


def patches(image: torch.Tensor, side: int) -> torch.Tensor:
    """Return the whole patches of an image [H, W], shape [P, side * side]; an image smaller than a patch is one patch."""
    side_y, side_x = (min(side, n) for n in image.shape)
    rows, columns = image.shape[0] // side_y, image.shape[1] // side_x
    cut = image[: rows * side_y, : columns * side_x].view(rows, side_y, columns, side_x)
    return cut.permute(0, 2, 1, 3).reshape(rows * columns, side_y * side_x)


def deviation(squares: torch.Tensor, counts: torch.Tensor) -> torch.Tensor:
    """Return standard deviations by sums of squares and numbers of pixels, both of any shape [...]."""
    return (squares / counts + SMALLEST**2).sqrt()


def depth_difference(
    found: torch.Tensor, given: torch.Tensor, counts: torch.Tensor, config: DnConfig = DnConfig()
) -> torch.Tensor:
    """Return the mean squared difference of normalised inverse depths, shape []; 0 if no pixel counts.

    Values of a patch have mean 0 after normalisation. They are divided by the patch's standard deviation (local), and by the
    image's (global). Both maps and whether a pixel counts are [H, W].
    """
    shown = patches(counts.to(found.dtype), config.patch)
    pixels = shown.sum(1, keepdim=True).clamp_min(1)
    every = total(shown).clamp_min(1)
    local, whole = [], []
    for image in (found, given):
        values = patches(image, config.patch)
        centred = (values - (values * shown).sum(1, keepdim=True) / pixels) * shown
        spread = (values - total(values * shown) / every) * shown
        local.append(centred / deviation((centred * centred).sum(1, keepdim=True), pixels))
        whole.append(centred / deviation(total(spread * spread), every))
    loss = found.new_zeros(())
    for (one, other), weight in ((local, config.local), (whole, config.whole)):
        gap = (one - other).abs()
        loss = loss + weight * total(torch.where(gap > config.tolerance, gap * gap, 0)) / every
    return loss


@register_strategy("dngaussian")
class DNGaussian(CloneSplit):
    """Clones and splits as 3DGS, with the hard and the soft depth term of one training view in each step.

    A step is captured as a CUDA graph. So the order of views is sampled before the first step, and each step looks up its own.
    """

    Config = DnConfig

    @classmethod
    def needs_priors(cls, own: Any) -> bool:
        """Return that the strategy reads disparities."""
        return True

    def setup(self) -> None:
        """Sample the order of views.

        Raises:
            UsageError: The training views have several sizes or a distorted lens.
        """
        context, views = self.context, self.context.views
        if len({v.image.shape for v in views}) > 1 or any(v.camera.distortion is not None for v in views):
            raise warpgs.UsageError(
                "dngaussian needs training views of one size, without lens distortion; use another --strategy"
            )
        device, steps = context.device, context.steps
        orders = [torch.randperm(len(views), generator=context.generator) for _ in range(-(-steps // len(views)))]
        self.order, self.taken = torch.cat(orders)[:steps].to(device), torch.zeros(1, dtype=torch.int64, device=device)
        self.viewmats, self.Ks = (torch.stack([getattr(v.camera, n) for v in views]) for n in ("viewmat", "K"))
        self.disparities = torch.stack([torch.as_tensor(p.disparity, device=device) for p in context.priors])
        self.masks = torch.stack([torch.ones_like(v.image[..., 0]) if v.countable is None else v.countable for v in views])
        self.overflow = torch.zeros(1, dtype=torch.int32, device=device)
        self._measure()

    @torch.no_grad()
    def _measure(self) -> None:
        """Choose the renderer: on CUDA, one with a fixed capacity for (Gaussian, tile) pairs, for capture as a graph."""
        context, options = self.context, self.context.render_options()
        self.render = eager_renderer(options, None)
        if context.device.type == "cuda":
            most = most_instances(self.opaque(context.gaussians), [v.camera for v in context.views], options)
            self.render = captured_renderer(options, SPARE * most + MIN_INSTANCES, self.overflow)

    def regularisation(self, phase: Hashable, gaussians: warpgs.Gaussians) -> torch.Tensor:
        """Return the weighted depth terms of the step's view, shape []."""
        self.overflow.zero_()
        hard, soft = self.terms(gaussians)
        return torch.where(self.overflow[0] != 0, torch.nan, self.config.weight * (hard + soft))  # NaN ends the fit

    def terms(self, gaussians: warpgs.Gaussians) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the hard term, whose gradient reaches the means, and the soft one, for the opacities, shape [] each."""
        view = self.order.index_select(0, self.taken)
        viewmat, K, given, mask = (t.index_select(0, view) for t in (self.viewmats, self.Ks, self.disparities, self.masks))
        camera = dataclasses.replace(self.context.views[0].camera, viewmat=viewmat, K=K)
        fixed = {n: t.detach() for n, t in gaussians.tensors().items()}
        hard = self.opaque(warpgs.Gaussians(**(fixed | {"means": gaussians.means})))
        soft = warpgs.Gaussians(**(fixed | {"logit_opacities": gaussians.logit_opacities}))
        renders = (self.render(g, camera, 0, None, None) for g in (hard, soft))
        one, other = (self._term(r, given[0], mask[0]) for r in renders)
        return one, other

    def opaque(self, gaussians: warpgs.Gaussians) -> warpgs.Gaussians:
        """Return the Gaussians with the opacity of hard depth."""
        logit = math.log(self.config.opacity / (1 - self.config.opacity))
        return dataclasses.replace(gaussians, logit_opacities=torch.full_like(gaussians.logit_opacities, logit))

    def _term(self, render: warpgs.Render, given: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        """Return the difference of a render's depth to a disparity [H, W], shape []; 0 if the disparity is unknown."""
        shown = (render.alpha > MIN_ALPHA) & (mask > 0) & (given.amax() > 0)
        depth = torch.where(shown, render.depth, 1)
        middle = total(torch.where(shown, depth.detach(), 0)) / shown.sum().clamp_min(1)  # so that the unit does not matter
        return depth_difference(torch.where(shown, middle / depth, 0), given, shown, self.config)

    def after_step(self, phase: Hashable, settings: torch.Tensor, going: torch.Tensor) -> None:
        """Count the step if ``going`` [1] is True; ``settings`` [7] are not read."""
        self.taken += going.to(torch.int64)

    def update(self, step: int) -> Iterator[DensityUpdate]:
        """Refine and reset opacities, each if it is due, and measure the capacity anew."""
        yield from super().update(step)
        self._measure()

    def state(self) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
        """Return the number of steps [1], and whether opacities were reset."""
        tensors, plain = super().state()
        return tensors | {"taken": self.taken}, plain

    def load(self, tensors: Mapping[str, torch.Tensor], plain: dict[str, Any]) -> None:
        """Load what `state` returned, tensors [...] and plain values."""
        super().load(tensors, plain)
        self.taken.copy_(tensors["taken"])
        self._measure()


dngaussian = {
    "base": "3dgs",
    "about": "DNGaussian (Li et al. 2024), 6000 steps",
    "strategy": DNGaussian,
    "loss.depth-weight": 0,
    "steps": 6000,
    "optimizer.scales-lr": 0.003,
    "density.gradient": 1.3e-3,
    "density.stop-fraction": 1.0,
    "density.prune-size": 0,
}
