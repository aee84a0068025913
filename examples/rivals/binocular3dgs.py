"""Binocular3DGS (Han et al., NeurIPS 2024, arXiv 2410.18822) as a plug-in: stereo consistency and opacity decay.

    warpgs fit path/to/scene --out run --preset examples/rivals/binocular3dgs.py:binocular3dgs --split llff:3

Late in a fit a training camera moves sideways by a random distance s. The moved camera's render, warped back by the disparity
f s / z of the training view's rendered depth z, must equal the photograph. Every step multiplies each opacity by 0.995
(`--optimizer.opacities-decay`), instead of opacity resets.
Constants are those of the authors' `train.py` and `arguments` (hanl2010/Binocular3DGS, 0a83fd5d); that the paper has the
same ones is not confirmed.
Missing here: the start from matches of PDCNet+, the smoothness of the disparity (weight 0.05), and a decay that begins after
500 steps. The authors' largest distance of 0.4 is in units of the files of LLFF; ours is in extents of the scene.
"""

import dataclasses
from collections.abc import Hashable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import warpgs
from warpgs.train import (
    STEP,
    CloneSplit,
    DensityUpdate,
    Needs,
    StepSizes,
    captured_renderer,
    eager_renderer,
    most_instances,
    register_strategy,
    total,
)

import torch

SPARE, MIN_INSTANCES = 3, 100_000
"""Capacity for (Gaussian, tile) instances of a captured render: `SPARE` times the most instances of a training view, plus
`MIN_INSTANCES`."""
MIN_ALPHA = 0.5
"""Opacity above which a pixel has a depth."""
WARP_MAPS = 8
"""Number of maps with one float for each pair of pixels of a row, which warping and its gradient hold."""


@dataclass(frozen=True)
class BinocularConfig:
    """Settings of the strategy."""

    weight: float = 1.0
    """Weight of the stereo term."""
    distance: float = 0.1
    """Largest distance that a camera moves, as a fraction of the scene's extent: 0.4 units of the files are 0.06 to 0.14
    extents on fern, horns, room and trex with three views."""
    begins: float = 2 / 3
    """Fraction of the steps before which there is no stereo term: 20,000 of 30,000."""


def warped(image: torch.Tensor, disparity: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the image [H, W, 3] at x - disparity, linear between pixels, and whether that place is in the image, [H, W].

    ``disparity`` [H, W] is in px. Each row is a product with a matrix of weights: unlike the gradient of a gather, its gradient
    has the same bits in every run.
    """
    x = torch.arange(image.shape[1], dtype=image.dtype, device=image.device)
    weights = (1 - (x - (x[:, None] - disparity[..., None])).abs()).clamp_min(0)
    place = x - disparity.detach()
    return weights @ image, (place >= 0) & (place <= image.shape[1] - 1)


def stereo_difference(image: torch.Tensor, moved: torch.Tensor, disparity: torch.Tensor, counts: torch.Tensor) -> torch.Tensor:
    """Return the mean absolute difference of an image and the moved camera's, warped, shape []; 0 if no pixel counts.

    Images are [H, W, 3], the disparity [px] and whether a pixel counts are [H, W].
    """
    found, inside = warped(moved, disparity)
    counts = inside & counts
    difference = torch.where(counts[..., None], (found - image).abs(), 0)
    return total(difference) / (3 * counts.sum().clamp_min(1))


@register_strategy("binocular3dgs")
class Binocular3DGS(CloneSplit):
    """Clones and splits as 3DGS, and compares each photograph with a render from a camera beside it.

    A step is captured as a CUDA graph. So all random numbers are sampled before the first step, and each step looks up its own.
    """

    Config = BinocularConfig

    def setup(self) -> None:
        """Sample the order of views and the movements of cameras.

        Raises:
            UsageError: The training views have several sizes, an alpha channel or a distorted lens.
        """
        context, views = self.context, self.context.views
        if len({v.image.shape for v in views}) > 1 or any(
            v.alpha is not None or v.camera.distortion is not None for v in views
        ):
            raise warpgs.UsageError(
                "binocular3dgs needs opaque training views of one size, without lens distortion; use another --strategy"
            )
        device, steps, generator = context.device, context.steps, context.generator
        orders = [torch.randperm(len(views), generator=generator) for _ in range(-(-steps // len(views)))]
        shifts = self.config.distance * context.extent * (2 * torch.rand(steps, generator=generator) - 1)
        self.order, self.shifts = torch.cat(orders)[:steps].to(device), shifts.to(device)
        self.taken = torch.zeros(1, dtype=torch.int64, device=device)
        self.viewmats, self.Ks = (torch.stack([getattr(v.camera, n) for v in views]) for n in ("viewmat", "K"))
        self.images = torch.stack([v.image for v in views])
        self.masks = torch.stack([torch.ones_like(v.image[..., 0]) if v.mask is None else v.mask for v in views])
        self.overflow = torch.zeros(1, dtype=torch.int32, device=device)
        self._measure()

    @torch.no_grad()
    def _measure(self) -> None:
        """Choose the renderer: on CUDA, one with a fixed capacity for (Gaussian, tile) pairs, for capture as a graph."""
        context, options = self.context, self.context.render_options()
        self.render = eager_renderer(options, None)
        if context.device.type == "cuda":
            most = most_instances(context.gaussians, [v.camera for v in context.views], options)
            self.render = captured_renderer(options, SPARE * most + MIN_INSTANCES, self.overflow)

    def bytes(self, sizes: StepSizes) -> Needs:
        """Return the bytes of the weights of `warped` and of their gradients."""
        return dict.fromkeys(STEP, WARP_MAPS * 4 * sizes.pixels * sizes.width)

    def phase(self, step: int) -> Hashable:
        """Return whether gradients are gathered in a step, and whether it has the stereo term."""
        return super().phase(step), step > self.config.begins * self.context.steps

    def statistics(
        self, phase: Hashable, v_projected: torch.Tensor, visible: torch.Tensor, size: tuple[int, int]
    ) -> Mapping[str, torch.Tensor]:
        """Return statistics of gradients, [N] each; ``v_projected`` has shape [1, N, 12], ``visible`` [1, N]."""
        assert isinstance(phase, tuple)
        return super().statistics(phase[0], v_projected, visible, size)

    def regularisation(self, phase: Hashable, gaussians: warpgs.Gaussians) -> torch.Tensor | None:
        """Return the weighted stereo term of the step's view, shape []; None before it begins."""
        assert isinstance(phase, tuple)
        if not phase[1]:
            return None
        self.overflow.zero_()
        view, shift = self.order.index_select(0, self.taken), self.shifts.index_select(0, self.taken)
        viewmat, K, image, mask = (t.index_select(0, view) for t in (self.viewmats, self.Ks, self.images, self.masks))
        moved = torch.cat([torch.cat([viewmat[:, :1, :3], viewmat[:, :1, 3:] - shift], 2), viewmat[:, 1:]], 1)
        first, second = (
            self.render(
                gaussians, dataclasses.replace(self.context.views[0].camera, viewmat=v, K=K), gaussians.sh_degree, None, None
            )
            for v in (viewmat, moved)
        )
        seen = first.alpha > MIN_ALPHA
        disparity = K[0, 0, 0] * shift / torch.where(seen, first.depth, 1)
        term = self.config.weight * stereo_difference(image[0], second.rgb, disparity, seen & (mask[0] > 0))
        return torch.where(self.overflow[0] != 0, torch.nan, term)  # NaN ends the fit

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


binocular3dgs = {
    "base": "3dgs",
    "about": "Binocular3DGS (Han et al. 2024), 30000 steps",
    "strategy": Binocular3DGS,
    "steps": 30_000,
    "optimizer.opacities-decay": 0.005,  # opacities times 0.995 (opacity decay strategy)
    "optimizer.scales-lr": 0.005,
    "density.stop-fraction": 1.0,
    "density.prune-size": 0,
}
