"""A plain training loop around gsplat's rasterizer and its two strategies, with the settings of its own example trainer.

gsplat is called, never copied. `Settings` has the settings of ``examples/simple_trainer.py`` of nerfstudio-project/gsplat:
``mcmc`` at 90d7b4b3 (2026-08-20), and ``default``, with the thresholds of `DefaultStrategy`. `train` has the same operations in
the same order as that script. The script uses fused-ssim with padding "valid", that is, the map without the 5 pixels at each
edge. Our SSIM, which is also fused, has the same values.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch

from warpgs.errors import UsageError
from warpgs.kernels.neighbours import mean_square_distances
from warpgs.kernels.ssim import ssim
from warpgs.scene import C0, Camera, Gaussians, Normalization, Scene, View

BLACK = (0.0, 0.0, 0.0)
EDGE = 5
"""Width of the image border that "valid" SSIM leaves out [px]: half of its window."""


@dataclass(frozen=True)
class Settings:
    """Settings of gsplat's example trainer, by default for MCMC; lengths are in the units of its world."""

    steps: int
    cap: int
    """Most Gaussians of MCMC; the default strategy has no limit."""
    strategy: str = "mcmc"
    """mcmc or default."""
    init_opacity: float = 0.5
    init_scale: float = 0.1
    """Ratio of the initial width of a Gaussian to the root mean square distance to its three neighbours."""
    opacity_reg: float = 0.01
    scale_reg: float = 0.01
    ssim_lambda: float = 0.2
    sh_degree: int = 3
    sh_every: int = 1000
    """Steps after which the degree in use rises by one."""
    means_lr: float = 1.6e-4
    """Learning rate of the means in units of the scene's size; it falls to a hundredth at the last step."""
    scales_lr: float = 5e-3
    opacities_lr: float = 5e-2
    quats_lr: float = 1e-3
    sh0_lr: float = 2.5e-3
    sh_rest_lr: float = 2.5e-3 / 20
    noise_lr: float = 5e5
    refine_start: int = 500
    refine_every: int = 100
    full_steps: int = 30_000
    """Length of the schedule that `refine_stop` belongs to."""
    refine_stop: int = 25_000
    reset_every: int = 3000
    """Steps between resets of the opacity, by the default strategy alone."""
    background: tuple[float, float, float] = BLACK
    """Colour behind the scene; gsplat's trainer uses black."""

    @property
    def last_refinement(self) -> int:
        """The step at which refinement stops, scaled to the length of this run."""
        return self.refine_stop * self.steps // self.full_steps


def default_settings(steps: int) -> Settings:
    """Return the settings for gsplat's default strategy, whose refinement ends at half of the steps, as at 15,000 of 30,000.

    Until the end of refinement, gsplat 1.6.0 resets opacities every 3000 steps. Version 1.5.3 never does, because its condition
    ``step % reset_every == 0 & step > 0`` is always false in Python.
    """
    return Settings(
        steps, cap=0, strategy="default", init_opacity=0.1, init_scale=1.0, opacity_reg=0.0, scale_reg=0.0, refine_stop=15_000
    )


def scaled_settings(strategy: str, steps: int, cap: int) -> Settings:
    """Return the settings of a strategy with all counts of steps in proportion, as by ``--steps-scaler`` of its trainer."""
    made = default_settings(steps) if strategy == "default" else Settings(steps, cap)
    names = ("sh_every", "refine_start", "refine_every", "reset_every")
    return replace(made, **{n: max(1, getattr(made, n) * steps // made.full_steps) for n in names})


def own_scale(cameras: list[Camera], normalization: Normalization) -> float:
    """Return the length of our unit in gsplat's world: its parser scales the median distance of cameras to their focus to 1.

    The focus is the median, over cameras, of the point on the optical axis nearest to the origin of the files.
    """
    centers = np.array([c.center for c in cameras]) / normalization.scale + normalization.offset
    axes = np.array([c.viewmat[2, :3] for c in cameras])
    nearest = centers - (axes * centers).sum(1, keepdims=True) * axes
    distance = np.median(np.linalg.norm(centers - np.median(nearest, axis=0), axis=1))
    return 1 / (float(distance) * normalization.scale)


def scene_scale(cameras: list[Camera], scale: float) -> float:
    """Return 1.1 times the largest distance of a camera from their mean, in gsplat's world."""
    centers = scale * np.array([c.center for c in cameras])
    return 1.1 * float(np.linalg.norm(centers - centers.mean(0), axis=1).max())


def start(points: torch.Tensor, colors: torch.Tensor, s: Settings) -> torch.nn.ParameterDict:
    """Return the first parameters: a Gaussian for each point [N, 3] with its colour [N, 3] in [0, 1].

    Coincident points get a width of 1e-9 units, because otherwise the logarithm would be infinite.
    """
    count = len(points)
    widths = mean_square_distances(points).sqrt().clamp_min(1e-9) * s.init_scale
    values = {
        "means": points.clone(),
        "scales": torch.log(widths)[:, None].repeat(1, 3),
        "quats": torch.rand(count, 4, device=points.device),
        "opacities": torch.logit(torch.full((count,), s.init_opacity, device=points.device)),
        "sh0": ((colors - 0.5) / C0)[:, None].contiguous(),
        "shN": torch.zeros(count, (s.sh_degree + 1) ** 2 - 1, 3, device=points.device),
    }
    return torch.nn.ParameterDict({n: torch.nn.Parameter(t) for n, t in values.items()})


def optimizers_of(params: torch.nn.ParameterDict, s: Settings, size: float) -> dict[str, torch.optim.Adam]:
    """Return an Adam for each parameter, as the strategy asks for."""
    lrs = {
        "means": s.means_lr * size, "scales": s.scales_lr, "quats": s.quats_lr, "opacities": s.opacities_lr,
        "sh0": s.sh0_lr, "shN": s.sh_rest_lr,
    }  # fmt: skip
    fused = params["means"].is_cuda
    return {n: torch.optim.Adam([{"params": params[n], "lr": lr, "name": n}], eps=1e-15, fused=fused) for n, lr in lrs.items()}


def render(params, viewmat: torch.Tensor, K: torch.Tensor, width: int, height: int, degree: int, background=BLACK):
    """Return gsplat's image [H, W, 3] over a background [3], and its rasterizer's info for the strategy."""
    from gsplat import rasterization

    behind = {"backgrounds": torch.tensor([background], device=viewmat.device)} if any(background) else {}
    rgb, _, info = rasterization(
        means=params["means"], quats=params["quats"], scales=params["scales"].exp(),
        opacities=params["opacities"].sigmoid(), colors=torch.cat([params["sh0"], params["shN"]], 1),
        viewmats=viewmat[None], Ks=K[None], width=width, height=height, sh_degree=degree, packed=False, **behind,
    )  # fmt: skip
    return rgb[0], info


def loss_of(image: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None, params, s: Settings) -> torch.Tensor:
    """Return L1 and SSIM of images [H, W, 3] where the mask [H, W] is True, and the two regularizers."""
    if mask is None:
        l1 = (image - target).abs().mean()
    else:
        l1 = (image - target)[mask].abs().mean()
        image, target = image * mask[..., None], target * mask[..., None]
    similarity = ssim(image, target)[EDGE:-EDGE, EDGE:-EDGE].mean()
    regular = s.opacity_reg * params["opacities"].sigmoid().mean() + s.scale_reg * params["scales"].exp().mean()
    return (1 - s.ssim_lambda) * l1 + s.ssim_lambda * (1 - similarity) + regular


def strategy_of(s: Settings, size: float):
    """Return gsplat's strategy for a scene of that size in its world, and the first state of the strategy."""
    import gsplat

    times = {"refine_start_iter": s.refine_start, "refine_stop_iter": s.last_refinement, "refine_every": s.refine_every}
    if s.strategy == "default":
        strategy = gsplat.DefaultStrategy(**times, reset_every=s.reset_every)
        return strategy, strategy.initialize_state(scene_scale=size)
    strategy = gsplat.MCMCStrategy(cap_max=s.cap, noise_lr=s.noise_lr, **times)
    return strategy, strategy.initialize_state()


@dataclass(frozen=True)
class _Loaded:
    """A training view on the device, in gsplat's world."""

    viewmat: torch.Tensor
    K: torch.Tensor
    image: torch.Tensor
    mask: torch.Tensor | None


def loaded(view: View, device: torch.device, scale: float) -> _Loaded:
    """Return a view on the device with our unit ``scale`` long."""
    viewmat = np.array(view.camera.viewmat, dtype=np.float64)
    viewmat[:3, 3] *= scale
    there = [torch.as_tensor(a, dtype=torch.float32, device=device) for a in (viewmat, view.camera.K, view.image)]
    return _Loaded(*there, None if view.mask is None else torch.as_tensor(view.mask, device=device))


def train(
    views: list[View], first: Gaussians, s: Settings, *, seed: int, scale: float, size: float, draw: Callable = render,
    watch: Callable[[int, dict], object] = lambda step, params: None,
) -> dict:  # fmt: skip
    """Train from the positions and colours of the first Gaussians, and return gsplat's parameters in its own world.

    ``watch`` is called after each step with the number of steps and the parameters.
    """
    device = first.means.device
    torch.manual_seed(seed)
    params = start(scale * first.means.detach(), C0 * first.sh.detach()[:, 0] + 0.5, s)
    optimizers = optimizers_of(params, s, size)
    strategy, state = strategy_of(s, size)
    strategy.check_sanity(params, optimizers)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizers["means"], gamma=0.01 ** (1 / s.steps))
    there, order = [loaded(v, device, scale) for v in views], []
    for step in range(s.steps):
        order = order or torch.randperm(len(there)).tolist()
        view = there[order.pop()]
        height, width = view.image.shape[:2]
        image, info = draw(params, view.viewmat, view.K, width, height, min(step // s.sh_every, s.sh_degree), s.background)
        strategy.step_pre_backward(params=params, optimizers=optimizers, state=state, step=step, info=info)
        loss_of(image, view.image, view.mask, params, s).backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        schedule.step()
        last = {"lr": schedule.get_last_lr()[0]} if s.strategy == "mcmc" else {}
        strategy.step_post_backward(params=params, optimizers=optimizers, state=state, step=step, info=info, **last)
        watch(step + 1, params)
    return params


def fit(
    scene: Scene, views: list[View], first: Gaussians, s: Settings, *, seed: int, own_units: bool = True,
    draw: Callable = render,
):  # fmt: skip
    """Train on views of a scene; return the parameters, and seconds, count, unit and size of the scene as figures of a row."""
    if any(scene.background) and scene.background != s.background:
        raise UsageError(f"{scene.path}: its background is {scene.background}, but the settings have {s.background}")
    cameras, began = [view.camera for view in scene.views], time.perf_counter()
    unit = own_scale(cameras, scene.normalization) if own_units else 1.0
    size = scene_scale(cameras, unit)
    params = train(views, first, s, seed=seed, scale=unit, size=size, draw=draw)
    if first.means.is_cuda:
        torch.cuda.synchronize(first.means.device)
    row = {"points": len(first), "gaussians": len(params["means"]), "unit": unit, "scene_scale": size}
    return params, row | {"seconds": time.perf_counter() - began}


@torch.no_grad()
def image_of(params, view: View, scale: float, draw: Callable = render, background=BLACK) -> np.ndarray:
    """Return the image of a view over a background [3], in [0, 1], shape [H, W, 3], all coefficients in use."""
    there = loaded(view, params["means"].device, scale)
    degree = math.isqrt(params["shN"].shape[1] + 1) - 1
    size = view.camera.width, view.camera.height
    return draw(params, there.viewmat, there.K, *size, degree, background)[0].clamp(0, 1).cpu().numpy()


def compile_kernels(device: torch.device) -> None:
    """Render a few Gaussians with gradients: gsplat builds its kernels at the first call, which takes minutes."""
    points = torch.rand(8, 3, device=device)
    params = start(points, points, default_settings(1))
    viewmat, K = torch.eye(4, device=device), torch.tensor([[16.0, 0, 8], [0, 16, 8], [0, 0, 1]], device=device)
    render(params, viewmat, K, 16, 16, 0)[0].sum().backward()
