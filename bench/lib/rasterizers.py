"""CUDA rasterizers (ours, gsplat, Faster-GS and gswarp) with one interface: a scene in, an image and gradients out.

Tensors are converted to the layout of each program before anything is timed. Activations that a program leaves to its user are
timed with it, as in its own trainer.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from bench.lib import inputs
from warpgs import RasterizeOptions, rasterize
from warpgs.constants import LARGEST_ALPHA, Rule
from warpgs.scene import Camera, Gaussians

OURS = "warpgs"
UNRECORDED = "warpgs, never recorded"
ATOMIC = "warpgs atomic"
GSPLAT = "gsplat dense"
GSPLAT_PACKED = "gsplat packed"
FASTER_GS = "Faster-GS"
GSWARP = "gswarp"

FASTER_GS_RULE = Rule("Faster-GS", alpha_max=LARGEST_ALPHA)
"""Faster-GS at 3cb0b75: no clamp of alpha; the Gaussian that crosses the stop is blended."""


@dataclass(frozen=True)
class Drawing:
    """A scene and one camera as a program takes them."""

    draw: Callable[[], torch.Tensor]
    """Draw the image, in the program's layout."""
    leaves: dict[str, torch.Tensor]
    """Tensors that get gradients; ``sh0`` and ``sh_rest`` where coefficients are split."""
    channels_first: bool = False
    """True for images [D, H, W], else [..., H, W, D]."""

    def upstream(self, image: torch.Tensor) -> torch.Tensor:
        """Return an image [H, W, D] in the program's layout."""
        return image.permute(2, 0, 1).contiguous() if self.channels_first else image[None]

    def image(self) -> torch.Tensor:
        """Draw, and return the image as [H, W, D]."""
        drawn = self.draw()
        return drawn.permute(1, 2, 0) if self.channels_first else drawn[0]

    def gradients(self, upstream: torch.Tensor) -> list[torch.Tensor]:
        """Draw, and return the gradients of the leaves for one of the image, in the program's layout."""
        return torch.autograd.grad(self.draw(), list(self.leaves.values()), upstream)

    def named_gradients(self, image: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return the gradients by our names and in our shapes, for one of the image [H, W, D]."""
        found = dict(zip(self.leaves, self.gradients(self.upstream(image)), strict=True))
        if "sh0" in found:
            found["sh"] = torch.cat([found.pop("sh0"), found.pop("sh_rest")], 1)
        return {name: g.squeeze(-1) if name == "logit_opacities" and g.ndim == 2 else g for name, g in found.items()}


def _leaves(g: Gaussians) -> dict[str, torch.Tensor]:
    return {name: t.detach().clone().requires_grad_() for name, t in g.tensors().items()}


def _with_colors(leaves: dict[str, torch.Tensor], colors: torch.Tensor | None) -> dict[str, torch.Tensor]:
    """Return the leaves, with colours [N, D] in place of the coefficients where they are given."""
    if colors is None:
        return leaves
    return {n: t for n, t in leaves.items() if n != "sh"} | {"colors": colors.detach().clone().requires_grad_()}


def ours(g: Gaussians, camera: Camera, colors: torch.Tensor | None = None, **options) -> Drawing:
    """Return our drawing; ``options`` are those of `RasterizeOptions`."""
    every = _leaves(g)
    leaves, seen = _with_colors(every, colors), Gaussians(**every)
    chosen = RasterizeOptions(colors=leaves.get("colors"), **options)
    return Drawing(lambda: rasterize(seen, camera, chosen).rgb, leaves)


def gsplat(g: Gaussians, camera: Camera, colors: torch.Tensor | None = None, **options) -> Drawing:
    """Return gsplat's drawing; ``options`` are those of its `rasterization`."""
    from gsplat import rasterization

    leaves = _with_colors(_leaves(g), colors)
    options = {"packed": False} | options

    def draw():
        return rasterization(
            leaves["means"], leaves["quats"], leaves["log_scales"].exp(), leaves["logit_opacities"].sigmoid(),
            leaves["sh" if colors is None else "colors"], camera.viewmat, camera.K, camera.width, camera.height,
            sh_degree=g.sh_degree if colors is None else None, **options,
        )[0]  # fmt: skip

    return Drawing(draw, leaves)


def _center(camera: Camera) -> torch.Tensor:
    """Return the position [3] of the first camera of a batch."""
    view = camera.viewmat[0]
    return -view[:3, :3].T @ view[:3, 3]


def faster_gs(g: Gaussians, camera: Camera) -> Drawing:
    """Return the drawing of Faster-GS; without gradients, it uses its code for images alone."""
    from FasterGSCudaBackend.torch_bindings.rasterization import RasterizerSettings, diff_rasterize, rasterize as draw_alone

    t = {name: v.detach() for name, v in g.tensors().items()}
    t |= {"sh0": t["sh"][:, :1], "sh_rest": t.pop("sh")[:, 1:], "logit_opacities": t["logit_opacities"][:, None]}
    leaves = {name: v.clone(memory_format=torch.contiguous_format).requires_grad_() for name, v in t.items()}
    given = [leaves[n] for n in ("means", "log_scales", "quats", "logit_opacities", "sh0", "sh_rest")]
    fx, _, cx, _, fy, cy = camera.K[0, :2].flatten().tolist()
    view, black, nothing = camera.viewmat[0].contiguous(), g.means.new_zeros(3), torch.empty(0)
    settings = RasterizerSettings(
        view, _center(camera), black, (g.sh_degree + 1) ** 2, camera.width, camera.height, fx, fy, cx, cy,
        FASTER_GS_RULE.near, FASTER_GS_RULE.far, False,
    )  # fmt: skip

    def draw():
        if torch.is_grad_enabled():
            return diff_rasterize(*given, nothing, settings)
        return draw_alone(*given, settings, to_chw=True, clamp_output=False)

    return Drawing(draw, leaves, channels_first=True)


def gswarp(g: Gaussians, camera: Camera) -> Drawing:
    """Return the drawing of gswarp, without its optional depth."""
    from gswarp import GaussianRasterizationSettings, GaussianRasterizer, set_compute_depth

    set_compute_depth(False)
    (fx, _, cx), (_, fy, cy), _ = camera.K[0].tolist()
    width, height, view = camera.width, camera.height, camera.viewmat[0]
    near, far = 0.01, 100.0
    through = torch.tensor(
        [
            [2 * fx / width, 0, 2 * cx / width - 1, 0],
            [0, 2 * fy / height, 2 * cy / height - 1, 0],
            [0, 0, far / (far - near), -far * near / (far - near)],
            [0, 0, 1, 0],
        ],
        device=view.device,
    )
    settings = GaussianRasterizationSettings(
        image_height=height, image_width=width, tanfovx=width / (2 * fx), tanfovy=height / (2 * fy),
        bg=g.means.new_zeros(3), scale_modifier=1.0, viewmatrix=view.T.contiguous(),
        projmatrix=(through @ view).T.contiguous(), sh_degree=g.sh_degree, campos=_center(camera), prefiltered=False,
        auto_tune_verbose=False,
    )  # fmt: skip
    leaves, rasterizer = _leaves(g), GaussianRasterizer(settings)
    screen = torch.zeros_like(g.means).requires_grad_()  # takes the gradients of the projected means, as in its trainer

    def draw():
        return rasterizer(
            means3D=leaves["means"], means2D=screen, opacities=leaves["logit_opacities"].sigmoid()[:, None],
            shs=leaves["sh"], scales=leaves["log_scales"].exp(),
            rotations=torch.nn.functional.normalize(leaves["quats"], dim=1),
        )[0]  # fmt: skip

    return Drawing(draw, leaves, channels_first=True)


PEERS: dict[str, Callable[..., Drawing]] = {
    GSPLAT: gsplat,
    GSPLAT_PACKED: lambda g, camera, colors=None: gsplat(g, camera, colors, packed=True),
    FASTER_GS: faster_gs,
    GSWARP: gswarp,
}
MANY_CHANNELS = (GSPLAT,)
"""Peers that blend any number of channels; the others blend three."""


def present(device: torch.device) -> tuple[dict[str, Callable[..., Drawing]], dict[str, str]]:
    """Return the peers that draw an image and its gradients on a device, and the others with the reason."""
    found, reasons = {}, {}
    for name, prepare in PEERS.items():
        try:
            drawing = prepare(inputs.gaussians(10, device), inputs.camera(32, 32, device))
            drawing.named_gradients(torch.ones(32, 32, 3, device=device))
            found[name] = prepare
        except Exception as e:  # whatever a foreign program fails with, the bench goes on without it
            reasons[name] = " ".join(f"{type(e).__name__}: {e}".split())[:200]
    return found, reasons
