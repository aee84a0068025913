"""The arguments and results of gsplat 1.6's `rasterization` on our rasterizer, for trainers that were written for gsplat.

    python examples/13_gsplat_rasterization.py --out fitted.png

Fits an image of coloured rings outside of a mask, and prints the PSNR before and after. Writes the image and its depth. Copy
`rasterization` into your trainer. Results are not packed. Arguments that the rasterizer lacks raise ValueError.
"""

import argparse
import dataclasses
from pathlib import Path
from typing import Any

import warpgs

import torch
from PIL import Image

MODELS = {"pinhole": "pinhole", "ortho": "orthographic", "fisheye": "fisheye"}
DEPTHS = {"RGB": "", "D": "D", "ED": "ED", "RGB+D": "D", "RGB+ED": "ED"}
AUTOMATIC = ("channel_chunk", "segmented")
"""Arguments of gsplat that change time and memory, but not the results; they are ignored."""
NEUTRAL = {"radius_clip": 0, "global_z_order": True}
"""Values of missing arguments that change nothing, besides None and False."""


def lens_of(camera_model: str, radial: torch.Tensor | None, tangential: torch.Tensor | None) -> dict[str, Any]:
    """Return model and distortion of `warpgs.Camera` for coefficients ``radial`` [C, 6] or [C, 4] and ``tangential`` [C, 2].

    Raises:
        ValueError: The camera model is unknown, or does not support the coefficients.
    """
    if camera_model not in MODELS:
        raise ValueError(f"camera_model must be one of {', '.join(MODELS)}, not {camera_model!r}")
    if (camera_model == "ortho" and radial is not None) or (camera_model != "pinhole" and tangential is not None):
        raise ValueError(
            f"camera_model {camera_model!r} does not support {'radial' if tangential is None else 'tangential'}_coeffs"
        )
    if camera_model == "fisheye":
        return {"model": "fisheye", "distortion": torch.zeros(4) if radial is None else radial}
    given = radial if radial is not None else tangential
    if given is None:
        return {"model": MODELS[camera_model]}
    radial = given.new_zeros(*given.shape[:-1], 6) if radial is None else radial
    tangential = given.new_zeros(*given.shape[:-1], 2) if tangential is None else tangential
    return {"model": "opencv", "distortion": torch.cat([radial[..., :2], tangential, radial[..., 2:]], -1)}


def rasterization(
    means: torch.Tensor, quats: torch.Tensor, scales: torch.Tensor, opacities: torch.Tensor, colors: torch.Tensor,
    viewmats: torch.Tensor, Ks: torch.Tensor, width: int, height: int, *,
    near_plane: float = 0.01, far_plane: float = 1e10, eps2d: float = 0.3, sh_degree: int | None = None, tile_size: int = 16,
    backgrounds: torch.Tensor | None = None, render_mode: str = "RGB", absgrad: bool = False, rasterize_mode: str = "classic",
    camera_model: str = "pinhole", radial_coeffs: torch.Tensor | None = None, tangential_coeffs: torch.Tensor | None = None,
    **others: Any,
) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:  # fmt: skip
    """Return images [C, H, W, D], alphas [C, H, W, 1] and the ``info`` that gsplat's strategies read, by gsplat's arguments.

    Raises:
        ValueError: An argument is not supported, or a mode or camera model is unknown.
    """
    given = {
        name: value for name, value in others.items() if name not in AUTOMATIC and value is not None and value is not False
    }
    if refused := [name for name, value in given.items() if name not in NEUTRAL or value != NEUTRAL[name]]:
        raise ValueError(f"warpgs does not support these arguments: {', '.join(refused)}; leave them out")
    if render_mode not in DEPTHS:
        raise ValueError(f"render_mode must be one of {', '.join(DEPTHS)}, not {render_mode!r}")
    if rasterize_mode not in ("classic", "antialiased"):
        raise ValueError(f"rasterize_mode must be classic or antialiased, not {rasterize_mode!r}")
    harmonics = sh_degree is not None
    camera = warpgs.Camera(viewmats, Ks, width, height, **lens_of(camera_model, radial_coeffs, tangential_coeffs))
    options = warpgs.RasterizeOptions(
        rule=dataclasses.replace(warpgs.rule_named("gsplat-1.6"), low_pass=eps2d),
        near=near_plane, far=far_plane, sh_degree=sh_degree, tile_size=tile_size, colors=None if harmonics else colors,
        background=backgrounds if "RGB" in render_mode else None, absgrad=absgrad, antialiased=rasterize_mode == "antialiased",
    )  # fmt: skip
    gaussians = warpgs.ActivatedGaussians(means, quats, scales, opacities, colors if harmonics else None)
    found = warpgs.rasterize(gaussians, camera, options)
    depth = {"": [], "D": [found.depth * found.alpha], "ED": [found.depth]}[DEPTHS[render_mode]]
    images = [found.rgb] * ("RGB" in render_mode) + [d[..., None] for d in depth]
    info = {
        "means2d": found.means2d,
        "radii": found.projected.detach()[..., 10:12].ceil(),
        "depths": found.projected[..., 9],
        "tiles_per_gauss": found.tile_counts,
        "gaussian_ids": None,  # only read in packed mode
        "width": width,
        "height": height,
        "n_cameras": len(found.projected),
    }
    return torch.cat(images, -1), found.alpha[..., None].clone(), info  # copies, which may be edited in place


def main(arguments: list[str] | None = None) -> float:
    """Run the example; return the gain in PSNR [dB]."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("fitted.png"), help="PNG to write")
    parser.add_argument("--steps", type=int, default=100, help="optimisation steps")
    parser.add_argument("--count", type=int, default=300, help="number of Gaussians")
    parser.add_argument("--size", type=int, default=64, help="side of the image [px]")
    a = parser.parse_args(arguments)

    torch.manual_seed(0)
    axis = torch.linspace(-1, 1, a.size)
    radius = torch.hypot(axis[None, :], axis[:, None])[None]
    target = 0.5 + 0.5 * torch.cos(12 * radius[..., None] + torch.tensor([0.0, 2.0, 4.0]))
    mask = radius > 0.3
    means = torch.cat([torch.rand(a.count, 2) - 0.5, torch.ones(a.count, 1)], 1)
    logits, colors = torch.zeros(a.count), torch.full((a.count, 3), 0.5)
    sizes, quats = torch.full((a.count, 3), 0.5 / a.count**0.5).log(), torch.randn(a.count, 4)
    parameters = [t.requires_grad_() for t in (means, quats, sizes, logits, colors)]
    optimizer = torch.optim.Adam(parameters, lr=0.02)
    K = torch.tensor([[a.size, 0, a.size / 2], [0, a.size, a.size / 2], [0, 0, 1.0]])
    scores = []
    for _ in range(a.steps):
        images, _, _ = rasterization(
            means, quats, sizes.exp(), logits.sigmoid(), colors, torch.eye(4)[None], K[None], a.size, a.size,
            render_mode="RGB+ED",
        )  # fmt: skip
        images[~mask] = 0  # as trainers do with their masks
        rgb, depth = images[..., :3], images[..., 3:].detach()
        scores.append(-10 * (rgb - target)[mask].square().mean().log10().item())
        optimizer.zero_grad()
        (rgb - target)[mask].abs().mean().backward()
        optimizer.step()

    row = torch.cat([rgb.detach(), (depth / 2).expand_as(rgb)], 2)[0].clamp(0, 1)
    Image.fromarray((row * 255).round().byte().numpy()).save(a.out)
    print(f"{a.steps} steps: PSNR {scores[0]:.1f} -> {scores[-1]:.1f} dB; images in {a.out}")
    return scores[-1] - scores[0]


if __name__ == "__main__":
    main()
