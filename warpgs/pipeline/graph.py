"""Training steps on CUDA as recorded graphs: the same kernels as step by step, without the host between them.

At sparse-view sizes a step keeps a GPU busy for less time than Python needs to launch it. So one step is recorded, from the
choice of the view to Adam, and replayed in bursts; rates and views of a burst are uploaded at once, losses read at its end.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from warpgs.constants import RULES
from warpgs.errors import ResourceError
from warpgs.kernels import bridge
from warpgs.kernels.blend import blend
from warpgs.kernels.burst import NOT_FINITE, begin_step, end_step
from warpgs.kernels.dropout import opacity_dropout
from warpgs.kernels.project import project
from warpgs.kernels.tiles import BYTES_PER_INSTANCE, MAX_INSTANCES, bin_tiles
from warpgs.pipeline.density import DensityStats
from warpgs.pipeline.layers import Layers, ProtectConfig
from warpgs.pipeline.loss import LossConfig, masked_mse, training_loss
from warpgs.pipeline.method import TrainingView
from warpgs.pipeline.optimizer import Optimizer
from warpgs.runtime.device_memory import available_bytes

BURST = 100
"""Most steps between two looks at the device."""
ROOM = 1.3
"""Instances that a recording has room for, as a multiple of the most that any view has when it is recorded."""
DEAD_BYTES = 2**30
"""Memory of recordings no longer used that may pile up. To give it back takes milliseconds, in which the device waits."""


@dataclass(frozen=True)
class Views:
    """Training views of one size on the device."""

    viewmats: torch.Tensor
    """camera_from_world, shape [V, 4, 4]."""
    Ks: torch.Tensor
    """Intrinsics [px], shape [V, 3, 3]."""
    targets: torch.Tensor
    """Colours in [0, 1], shape [V, H, W, 3]."""
    masks: torch.Tensor | None
    """1 where a pixel counts, else 0, shape [V, H, W]; None where all count."""
    disparities: torch.Tensor | None = None
    """Relative inverse depth in [0, 1], shape [V, H, W]; None where the loss does not look at depth."""


def stack_views(views: list[TrainingView]) -> tuple[dict[tuple, Views], list[tuple[tuple, int]]]:
    """Views by size and by whether they have a mask, as recorded steps take them, and where to find each."""
    kinds = [(v.camera.width, v.camera.height, v.mask is not None) for v in views]
    stacks = {}
    for kind in dict.fromkeys(kinds):
        same = [v for v, k in zip(views, kinds) if k == kind]
        stacks[kind] = Views(
            torch.stack([v.camera.viewmat for v in same]), torch.stack([v.camera.K for v in same]),
            torch.stack([v.photo for v in same]), torch.stack([v.mask for v in same]) if kind[2] else None,
            None if same[0].disparity is None else torch.stack([v.disparity for v in same]),
        )  # fmt: skip
    return stacks, [(k, kinds[:i].count(k)) for i, k in enumerate(kinds)]


class OverLimitError(ResourceError):
    """A recording would not keep to the fit's memory limit."""


class StepGraph:
    """A recorded step for one set of Gaussians, one image size and one degree.

    Views of a burst may have several sizes: then each size has a recording, and all share one `Burst`.
    """

    def __init__(
        self, views: Views, optimizer: Optimizer, stats: DensityStats | None, burst: Burst, *,
        degree: int, rule: str, loss: LossConfig, background: torch.Tensor, dropout_seed: int | None = None,
        share: torch.Tensor | None = None, protected: tuple[Layers, ProtectConfig] | None = None, most: int | None = None,
        fused: bool = False,
    ):  # fmt: skip
        """Record.

        Args:
            views: What steps may look at.
            optimizer: The Gaussians and their moments.
            stats: Where gradients are gathered for densification; None where they need not be.
            burst: Where steps find their settings and leave their results.
            degree: Spherical-harmonics degree.
            rule: Cut-offs of the rasterizer.
            loss: Weights of the loss.
            background: Colour behind the scene, shape [3].
            dropout_seed: Seed of the opacity dropout; None for none.
            share: Part of its step that each mean takes, shape [N]; None for all of it.
            protected: What holds up the opacity of the young; None where nothing does.
            most: Instances that the memory limit allows; None for no limit.
            fused: Whether projection's backward pass and Adam are one kernel, so that gradients never are in memory; the bits
                are then not those of single steps (docs/decisions/006-recorded-steps.md).

        Raises:
            OverLimitError: There is room for more than ``most`` instances to be made.
            ResourceError: The instances would not fit into memory.
        """
        self.views, self.optimizer, self.stats, self.burst = views, optimizer, stats, burst
        self.degree, self.rule, self.loss, self.background = degree, RULES[rule], loss, background[None]
        self.dropout_seed, self.share, self.protected, self.fused = dropout_seed, share, protected, fused
        self.height, self.width = views.targets.shape[1:3]
        self.capacity = self._capacity()
        if most is not None and self.capacity > most:
            raise OverLimitError(f"a recorded step would need room for {self.capacity:,} instances, the limit allows {most:,}")
        burst.give_back(0 if most is not None else DEAD_BYTES)
        stream = burst.stream
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            # a first run loads kernels and makes room in caches, which may not happen while recording
            burst.hold()
            self._step()
            burst.release()
            stream.synchronize()
            self.graph, self.lent = bridge.capture(self._step)
        torch.cuda.current_stream().wait_stream(stream)

    def _project(self, viewmat: torch.Tensor, K: torch.Tensor, factors: torch.Tensor | None = None):
        gaussians = self.optimizer.gaussians.tensors().values()
        size = {"width": self.width, "height": self.height}
        return project(*gaussians, viewmat, K, **size, degree=self.degree, rule=self.rule, opacity_factors=factors)

    def _capacity(self) -> int:
        with torch.no_grad():
            counts = [self._project(m[None], K[None])[1].sum() for m, K in zip(self.views.viewmats, self.views.Ks)]
        wanted = int(ROOM * int(torch.stack(counts).max())) + 1024
        budget = available_bytes(self.burst.device) * 4 // 5
        if wanted > MAX_INSTANCES or wanted * BYTES_PER_INSTANCE > budget:
            raise ResourceError(
                f"a step would touch {wanted:,} tiles, which needs {wanted * BYTES_PER_INSTANCE / 2**30:.2f} GiB; "
                f"{budget / 2**30:.2f} GiB may be used. Fit smaller images, or limit --density.max-gaussians."
            )
        return wanted

    def _step(self) -> None:
        burst, views, size = self.burst, self.views, {"width": self.width, "height": self.height}
        rows = (burst.view_rows, burst.rate_rows, burst.setting_rows, views.viewmats, views.Ks, views.targets)
        rates, settings, viewmat, K, target = begin_step(burst.counter, *rows)
        mask, disparity = (self._of_view(t) for t in (views.masks, views.disparities))
        factors = None
        if self.dropout_seed is not None:
            factors = opacity_dropout(len(self.optimizer.gaussians), settings, self.dropout_seed)
        with torch.set_grad_enabled(not self.fused):
            splats, counts = self._project(viewmat, K, factors)
        splats.requires_grad_()
        tiles = bin_tiles(splats, counts, **size, rule=self.rule, capacity=self.capacity, overflow=burst.stop)
        # not p[0], whose gradient would be a copy among zeros
        rgb, *rest = (p.squeeze(0) for p in blend(splats, tiles, self.background, **size, rule=self.rule))
        loss = training_loss((rgb, *rest), target, mask, disparity, self.loss)
        params = self.optimizer.params
        *gradients, v_splats = torch.autograd.grad(loss, [*(() if self.fused else params.values()), splats], burst.one)
        with torch.no_grad():
            going = end_step(loss, masked_mse(rgb, target, mask), burst.counter, burst.stop, burst.history)
            if self.fused:
                of = (viewmat, K, splats, counts, v_splats)
                how = {"degree": self.degree, "rule": self.rule, **size}
                self.optimizer.step_projected(*of, rates, burst.stop, self.share, **how)
            else:
                self.optimizer.step_scheduled(dict(zip(params, gradients)), rates, burst.stop, self.share)
            if self.protected is not None:
                layers, protect = self.protected
                layers.hold_up(params["logit_opacities"].detach(), settings[1], protect, going)
            if self.stats is not None:
                self.stats.add_gradient(v_splats, counts > 0, self.width, self.height, weight=going)

    def _of_view(self, maps: torch.Tensor | None) -> torch.Tensor | None:
        """The step's view of maps [V, H, W]; before the step is counted."""
        if maps is None:
            return None
        return maps.index_select(0, self.burst.view_rows.index_select(0, self.burst.counter))[0]

    def replay(self) -> None:
        """One step; the burst's counter says which."""
        self.graph.replay()


class Burst:
    """What the steps between two looks at the device read and write: their views and rates, losses, and the stop flag."""

    def __init__(self, device: torch.device):
        self.device = device
        self.stream = torch.cuda.Stream(device)
        """Where steps are recorded: always the same one, since torch keeps freed memory for the stream that it was used on."""
        self.kept = torch.cuda.memory_reserved(device)
        """Bytes that torch held after `give_back` last gave something back."""
        self.view_rows = torch.zeros(BURST, dtype=torch.int64, device=device)
        """Number of each step's view among those of its size."""
        self.rate_rows = torch.ones(BURST, 15, device=device)
        """Rates of each step (Optimizer.schedule)."""
        self.setting_rows = torch.zeros(BURST, 2, device=device)
        """Dropout probability and number of each step."""
        self.counter = torch.zeros(1, dtype=torch.int64, device=device)
        """Number of the step at hand. It stays once a step stops, and so do all Gaussians."""
        self.stop = torch.zeros(1, dtype=torch.int32, device=device)
        """0 while all is well, else why the burst stopped."""
        self.history = torch.zeros(BURST, 2, device=device)
        """Loss and mean squared error of each step."""
        self.one = torch.ones((), device=device)
        """Gradient of the loss."""

    def give_back(self, dead: int) -> None:
        """Return to the device what torch keeps for nobody, once that may be more than ``dead`` bytes.

        A recording has memory of its own, which torch keeps after the recording is gone and lends to no other.
        """
        if torch.cuda.memory_reserved(self.device) - self.kept > dead:
            torch.cuda.empty_cache()
            self.kept = torch.cuda.memory_reserved(self.device)

    def hold(self) -> None:
        """Until `release`, steps change nothing that lasts; they see the first view."""
        self.stop.fill_(NOT_FINITE)
        self.counter.zero_()
        self.view_rows.zero_()

    def release(self) -> None:
        """Undo `hold`."""
        self.stop.zero_()

    def load(self, views: list[int], rates: list[list[float]], settings: list[tuple[float, int]]) -> None:
        """Upload views, rates, and dropout probability and number of the next steps, at most BURST."""
        self.counter.zero_()
        self.stop.zero_()
        self.view_rows[: len(views)] = torch.tensor(views).to(self.device)
        self.rate_rows[: len(rates)] = torch.tensor(rates, dtype=torch.float32).to(self.device)
        self.setting_rows[: len(settings)] = torch.tensor(settings, dtype=torch.float32).to(self.device)

    def result(self) -> tuple[int, int, list[list[float]]]:
        """Steps taken, the stop flag, and loss and mean squared error of each step taken and of one that was not a number."""
        done, stop = int(self.counter), int(self.stop)
        return done, stop, self.history[: done + 1].tolist()
