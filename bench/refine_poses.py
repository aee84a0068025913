"""What poses that are a little off cost, and what `--refine-poses` regains: the same fit with given, noisy and refined poses.

usage: python -m bench.refine_poses SCENE [--split every:8] [--downscale 16] [--degrees 0.5] [--shift 0.01] [--preset quick]
       [--steps N] [--seed 0] [--device auto] --out FILE.json

Each training camera is turned about its centre by an angle and moved by a fraction of the cameras' extent, in random
directions; held-out cameras are as given, so that scores are of the true poses. The points of the scene stay, too.
"""

import argparse
import dataclasses
from pathlib import Path

import numpy as np
import torch

import warpgs
from warpgs.files import write_json
from warpgs.geometry import camera_extent, matmul
from warpgs.io.splits import split_views
from warpgs.pipeline.runs.refined_poses import pose_figures
from warpgs.pipeline.train.config import PRESETS
from warpgs.pipeline.train.refine_poses import increments
from warpgs.runtime.terminal import say
from warpgs.scene import Camera, Scene


def noisy_scene(scene: Scene, names: tuple[str, ...], degrees: float, shift: float, seed: int) -> Scene:
    """Return the scene with the named cameras turned by an angle and moved by a fraction of the cameras' extent."""
    generator = np.random.default_rng(seed)
    distance = shift * camera_extent([v.camera for v in scene.views])
    views = []
    for v in scene.views:
        camera = v.camera
        if v.name in names:
            w, t = (x / np.linalg.norm(x) for x in generator.standard_normal((2, 3)))
            w = 2 * np.tan(np.radians(degrees) / 2) * w
            motion = increments(torch.tensor(w), torch.tensor(distance * t)).numpy()
            camera = dataclasses.replace(camera, viewmat=matmul(motion, camera.viewmat))
        views.append(dataclasses.replace(v, camera=camera))
    return dataclasses.replace(scene, views=tuple(views))


def relative_errors(cameras: dict[str, Camera], truth: dict[str, Camera], names: tuple[str, ...]) -> float:
    """Return the mean angle [degrees] between relative rotations of pairs of cameras and the true ones, free of any gauge."""
    angles = []
    for i, a in enumerate(names):
        for b in names[i + 1 :]:
            found, true = (matmul(c[a].viewmat[:3, :3], c[b].viewmat[:3, :3].T) for c in (cameras, truth))
            angles.append(2 * np.arcsin(min(1.0, np.linalg.norm(found - true) / np.sqrt(8))))
    return float(np.degrees(np.mean(angles)))


def main() -> None:
    """Fit three times and write the figures."""
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("scene")
    p.add_argument("--split", default="every:8")
    p.add_argument("--downscale", type=int, default=16)
    p.add_argument("--degrees", type=float, default=0.5)
    p.add_argument("--shift", type=float, default=0.01)
    p.add_argument("--preset", default="quick")
    p.add_argument("--steps", type=int)
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--device", default="auto")
    p.add_argument("--out", required=True)
    a = p.parse_args()
    scene = warpgs.load_scene(a.scene, downscale=a.downscale)
    train = split_views(scene, a.split).train
    truth = {v.name: v.camera for v in scene.views}
    off = noisy_scene(scene, train, a.degrees, a.shift, a.seed)
    config = PRESETS[a.preset] if a.steps is None else dataclasses.replace(PRESETS[a.preset], steps=a.steps)
    rows = {}
    for name, data, refine in (("given", scene, False), ("noisy", off, False), ("refined", off, True)):
        fit = warpgs.fit(data, dataclasses.replace(config, refine_poses=refine), split=a.split, device=a.device, verbose=False)
        turn = [r["degrees"] for r in pose_figures(truth, fit.cameras(), train, (), 1.0)["views"]]
        rows[name] = {
            "psnr": fit.metrics["test"]["psnr"], "ssim": fit.metrics["test"]["ssim"],
            "train_psnr": fit.metrics["train"]["psnr"], "steps": fit.step, "seconds": fit.metrics["seconds"]["total"],
            "relative_degrees": relative_errors(fit.cameras(), truth, train), "degrees": float(np.mean(turn)),
        }  # fmt: skip
        say(f"{name}: {rows[name]}")
    lost, regained = rows["given"]["psnr"] - rows["noisy"]["psnr"], rows["refined"]["psnr"] - rows["noisy"]["psnr"]
    say(f"lost {lost:.2f} dB, regained {regained:.2f} dB")
    settings = {k: v for k, v in vars(a).items() if k not in ("out", "scene")} | {"scene": Path(a.scene).name}
    write_json(Path(a.out), {"settings": settings, "fits": rows, "lost_db": lost, "regained_db": regained})


if __name__ == "__main__":
    main()
