"""Cost of slightly wrong poses, and gain of `--refine-poses`: the same fits with given, noisy and refined poses.

Each training camera is turned about its centre by an angle and moved by a fraction of the cameras' extent, in random
directions; the points of the scene stay. Moved training cameras also move the model as a whole. So "psnr" uses held-out cameras
after the similarity from the true training cameras to those of the model, for noisy and for refined poses. "psnr_as_reported"
is the score that the fit itself reports, from the noisy cameras alone. With side-by-side cameras, a global bend of the scene is
nearly unconstrained, and a similarity cannot absorb it. So "psnr_cameras_refined" uses held-out cameras that are then moved to
where the finished model fits their photographs best, as is usual for learned poses (Lin et al. 2021, BARF, arXiv 2104.06405,
section 4). This is done for all three fits. The score does not depend on the position of the model.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import torch

import warpgs
from bench.lib import result_file
from bench.lib.arguments import SCENE, parse
from bench.lib.refined_views import refined
from warpgs.geometry import camera_extent, matmul
from warpgs.io.load import split_views
from warpgs.pipeline.run.request import choose_device
from warpgs.pipeline.train.presets import PRESETS
from warpgs.pipeline.train.view_modules import RefinePoses, increments, similar_cameras
from warpgs.process import say
from warpgs.scene import Camera, Scene

WHAT = "held-out PSNR with given, noisy and refined poses"


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


def figures(fit: warpgs.FitResult, truth: Scene, train: tuple[str, ...], test: tuple[str, ...]) -> dict[str, Any]:
    """Return the scores of a fit, and the errors of its training cameras."""
    true, found = {v.name: v.camera for v in truth.views}, fit.scene_cameras
    cameras = similar_cameras(true, [true[n] for n in train], [found[n] for n in train], test)
    views = [dataclasses.replace(truth.view(n), camera=cameras[n]) for n in test]
    scores = warpgs.evaluate(fit.scene_gaussians, views, fit.options())
    views = [refined(fit.scene_gaussians, v, fit.options()) for v in views]
    best = warpgs.evaluate(fit.scene_gaussians, views, fit.options())
    return {
        "psnr": float(np.mean([m.psnr for m in scores])), "psnr_cameras_refined": float(np.mean([m.psnr for m in best])),
        "psnr_as_reported": fit.metrics["test"]["psnr"],
        "train_psnr": fit.metrics["train"]["psnr"], "relative_degrees": relative_errors(found, true, train),
        "steps": fit.step, "seconds": fit.metrics["seconds"]["total"],
    }  # fmt: skip


def main() -> None:
    """Fit three times for each seed and write the figures."""
    a = parse(
        __doc__, None, SCENE, need=("out",), split="every:8", downscale=16, degrees=0.5, shift=0.01, preset="quick", steps=int,
        seeds=[0], device="auto", out=Path,
    )  # fmt: skip
    scene, rows = warpgs.load_scene(a.scene, downscale=a.downscale), []
    split, device = split_views(scene, a.split), choose_device(a.device)[0]
    for seed in a.seeds:
        config = dataclasses.replace(PRESETS[a.preset], seed=seed)
        config = config if a.steps is None else dataclasses.replace(config, steps=a.steps)
        off = noisy_scene(scene, split.train, a.degrees, a.shift, seed)
        for name, data, refine in (("given", scene, False), ("noisy", off, False), ("refined", off, True)):
            used = dataclasses.replace(config, view_modules=(RefinePoses(),) if refine else ())
            fit = warpgs.fit(data, used, split=a.split, device=device, verbose=False)
            rows.append({"poses": name, "seed": seed, "preset": a.preset, **figures(fit, scene, split.train, split.test)})
            say(f"seed {seed}, {name}: {rows[-1]}")
            asked = {"degrees": a.degrees, "shift": a.shift, "downscale": a.downscale, "split": a.split}
            result_file.keep(a.out, WHAT, device, rows, **asked)


if __name__ == "__main__":
    main()
