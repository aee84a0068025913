"""The rasterizer alone in a training loop of your own: plain torch, torch.optim, nothing else of warpgs in the loop.

    python examples/07_rasterizer_in_another_trainer.py path/to/scene --out render.png

Starts from the scene's points, or from random points if there are none. Prints the PSNR of a held-out view before and after;
writes the view's image beside the render, and the Gaussians as render.ply in the units of the scene's files.
"""

import argparse
import tempfile
from pathlib import Path

import warpgs

import numpy as np
import torch
from PIL import Image

LRS = {"means": 2e-3, "quats": 1e-3, "log_scales": 2e-2, "logit_opacities": 5e-2, "sh": 1e-2}
C0 = 0.28209479177387814  # 1 / (2 sqrt(pi)), the constant spherical harmonic


def initial_gaussians(scene: warpgs.Scene, count: int, device: torch.device) -> warpgs.Gaussians:
    """Return trainable Gaussians in scene units, at up to ``count`` points of the scene, or at random points if it has none."""
    generator = np.random.default_rng(0)
    if scene.points is None:
        positions, colors = generator.normal(size=(count, 3)), np.full((count, 3), 0.5)
    else:
        chosen = generator.permutation(len(scene.points))[:count]
        positions, colors = scene.points.points[chosen], scene.points.colors[chosen]
    points = torch.tensor(positions, dtype=torch.float32, device=device)
    distances = torch.cdist(points, points).topk(min(4, len(points)), largest=False).values[:, 1:].mean(1)
    tensors: dict[str, torch.Tensor] = {
        "means": points,
        "quats": torch.tensor([1.0, 0.0, 0.0, 0.0], device=device).repeat(len(points), 1),
        "log_scales": distances.clamp_min(1e-4).log()[:, None].repeat(1, 3),
        "logit_opacities": torch.full((len(points),), -1.0, device=device),
        "sh": ((torch.tensor(colors, dtype=torch.float32, device=device) - 0.5) / C0)[:, None, :],
    }
    return warpgs.Gaussians(**{name: t.requires_grad_() for name, t in tensors.items()})


def main(arguments: list[str] | None = None) -> float:
    """Run the example; return the gain in PSNR on a held-out view [dB]."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, nargs="?", help="scene folder; default: a synthetic scene")
    parser.add_argument("--out", type=Path, default=Path("render.png"), help="PNG to write; a PLY file is written beside it")
    parser.add_argument("--steps", type=int, default=300, help="optimisation steps")
    parser.add_argument("--count", type=int, default=2000, help="largest number of Gaussians")
    parser.add_argument("--width", type=int, default=96, help="width of the synthetic images [px]")
    a = parser.parse_args(arguments)

    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    with tempfile.TemporaryDirectory() as folder:
        if a.scene is None:
            a.scene = Path(folder) / "scene"
            warpgs.write_demo(a.scene, views=9, width=a.width, height=3 * a.width // 4)
        scene = warpgs.load_scene(a.scene)
    held_out, *train = scene.views[len(scene.views) // 2 :] + scene.views[: len(scene.views) // 2]
    images = [torch.from_numpy(v.image).to(device) for v in train]

    gaussians = initial_gaussians(scene, a.count, device)
    optimizer = torch.optim.Adam([{"params": [t], "lr": LRS[n]} for n, t in gaussians.tensors().items()], eps=1e-15)
    order = torch.Generator().manual_seed(0)
    first = warpgs.evaluate(gaussians, [held_out], warpgs.RasterizeOptions())[0].psnr
    for _ in range(a.steps):
        i = int(torch.randint(len(train), (1,), generator=order))
        rgb = warpgs.rasterize(gaussians, train[i].camera).rgb
        loss = (rgb - images[i]).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    last = warpgs.evaluate(gaussians, [held_out], warpgs.RasterizeOptions())[0].psnr
    with torch.no_grad():
        result = warpgs.rasterize(gaussians, held_out.camera).rgb.clamp(0, 1).cpu().numpy()
    Image.fromarray((np.concatenate([held_out.image, result], 1) * 255).round().astype(np.uint8)).save(a.out)
    # the loop and the cameras use scene units; the normalization converts to the units of the scene's files
    warpgs.write_ply(a.out.with_suffix(".ply"), gaussians, scene.normalization, units="scene")
    print(
        f"{len(gaussians)} Gaussians, {a.steps} steps: held-out PSNR {first:.2f} -> {last:.2f} dB; image and render in {a.out}"
    )
    return last - first


if __name__ == "__main__":
    main()
