"""Fits with found poses beside fits with given ones: held-out PSNR of the same photographs, and the distance of the poses.

SCENE is a COLMAP folder whose poses count as given, such as colmap/fern. Every eighth photograph is held out; --train of the
others, evenly spaced, are training views. Poses are found twice. First they are found for training and held-out photographs
jointly, like the given ones. Then they are found for the training photographs alone. In this case held-out cameras are the
given ones after the similarity that aligns the training cameras, with the found lens. Since this similarity is not exact, each
held-out camera is also scored at the pose where its photograph fits the model best. `--refine` also refines poses, or poses and
focal length, in the fits; held-out cameras are then aligned with the refined training cameras. `--work` keeps the found scenes,
for machines without pycolmap.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

import warpgs
from bench.lib import result_file
from bench.lib.arguments import SCENE, parse
from bench.lib.pose_errors import brought_over, errors
from bench.lib.refined_views import refined
from bench.lib.tables import mean_sd
from warpgs.io.images import Lens, ReadOptions, load_image
from warpgs.pipeline.run.request import choose_device
from warpgs.pipeline.train.view_modules import RefinePoses
from warpgs.poses.find import find_poses, read_poses_record
from warpgs.scene import Camera, Scene, View

HOLD_EVERY = 8
FOCAL_LR = 2e-4


def chosen(names: list[str], train: int) -> tuple[list[str], list[str]]:
    """Return the names of training and held-out photographs."""
    test, pool = names[::HOLD_EVERY], [n for i, n in enumerate(names) if i % HOLD_EVERY]
    return [pool[round(x)] for x in np.linspace(0, len(pool) - 1, train)], test


def found_scene(images: Path, names: list[str], downscale: int, folder: Path, matcher: Path | None) -> tuple[Scene, dict]:
    """Return the scene found from some photographs, kept in a folder, and the record of its poses."""
    if not (folder / "scene").is_dir():
        source = folder / "photographs"
        source.mkdir(parents=True)
        for name in names:
            (source / name).write_bytes((images / name).read_bytes())
        find_poses(source, folder / "scene", threads=2, matcher=matcher)
    return warpgs.load_scene(folder / "scene", downscale=downscale), read_poses_record(folder / "scene")


def held_out(view: View, camera: Camera, image: Path, found: dict, downscale: int, factor: float) -> View:
    """Return a held-out view from a camera, seen through the lens that was found: poses and focal length go together.

    The fit may have changed the focal length by a factor.
    """
    f, width, height = found["focal"], found["width"], found["height"]
    K = np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]])
    loaded = load_image(image, Lens(K, width, height, (found["distortion"], 0.0, 0.0, 0.0)), ReadOptions(downscale=downscale))
    K = loaded.K * [[factor, 1, 1], [1, factor, 1], [1, 1, 1]]
    return View(view.name, replace(camera, K=K), loaded.image, loaded.mask)


def psnr(result: warpgs.FitResult, views: list[View]) -> tuple[float, float]:
    """Return the mean PSNR of held-out views [dB], and that with each camera moved to where its photograph fits best."""
    options = result.options()
    best = [refined(result.scene_gaussians, v, options) for v in views]
    plain, moved = (warpgs.evaluate(result.scene_gaussians, vs, options) for vs in (views, best))
    return statistics.mean(m.psnr for m in plain), statistics.mean(m.psnr for m in moved)


def main() -> None:
    """Measure and write."""
    a = parse(
        __doc__, None, SCENE, train=[17, 6, 3], seeds=[0, 1, 2], preset="quick", downscale=4, device="cpu", refine=["none"],
        poses=["given", "joint", "aligned"], focal_lr=FOCAL_LR, matcher=Path, work=Path, out=Path,
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as temporary:
        measure(a, a.work or Path(temporary))


def measure(a: argparse.Namespace, work: Path) -> None:
    """Fit each number of photographs with each kind of poses, refined in each way."""
    given, rows, images = warpgs.load_scene(a.scene, downscale=a.downscale), [], a.scene / "images"
    reference = {v.name: v for v in given.views}
    ways = {"none": (), "poses": (RefinePoses(),), "focal": (RefinePoses(focal_lr=a.focal_lr),)}
    for count, poses in itertools.product(a.train, a.poses):
        train, test = chosen(list(reference), count)
        scene, record = given, None
        if poses != "given":
            names = [*train, *test] if poses == "joint" else train
            scene, record = found_scene(images, names, a.downscale, work / f"{count}_{poses}", a.matcher)
        there = [v.name for v in scene.views]
        train = [n for n in train if n in there]
        row = {"poses": poses, "train": count, "held_out": len(test), "preset": a.preset, "seeds": a.seeds}
        row |= {"downscale": a.downscale, "matcher": None if a.matcher is None else a.matcher.name}
        if record is not None:
            row |= errors({v.name: v for v in scene.views}, reference)
            row |= {k: record[k] for k in ("mean_reprojection_error_px", "points")}
            row |= {"registered": len(there), "focal_px": [c["focal"] for c in record["cameras"]]}
        for way in a.refine:
            config, scores, focal = replace(warpgs.PRESETS[a.preset], view_modules=ways[way]), [], []
            for seed in a.seeds:
                split = f"train={','.join(train)};test={','.join(n for n in test if n in there)}"
                result = warpgs.fit(scene, replace(config, seed=seed), split=split, device=a.device, verbose=False)
                K, cameras = scene.view(train[0]).camera.K, result.scene_cameras
                focal.append(float(cameras[train[0]].K[0, 0] / K[0, 0]))
                if poses == "aligned":
                    assert record is not None
                    over = brought_over(reference, {n: replace(reference[n], camera=cameras[n]) for n in train}, train, test)
                    (lens,) = record["cameras"]
                    views = [held_out(reference[n], over[n], images / n, lens, a.downscale, focal[-1]) for n in test]
                else:
                    views = [replace(scene.view(n), camera=cameras[n]) for n in test]
                scores.append(psnr(result, views))
            plain, best = ([s[k] for s in scores] for k in (0, 1))
            rows.append(row | {"refined": way, "psnr": plain, "psnr_cameras_refined": best, "focal_factors": focal})
            print(f"{count} views, {poses} poses, refined {way}: {mean_sd(plain)} dB; held-out cameras refined: "
                  f"{mean_sd(best)} dB; focal length times {np.mean(focal):.4f}", flush=True)  # fmt: skip
            what = "held-out PSNR with given and with found poses of the same photographs"
            result_file.keep(a.out, what, choose_device(a.device)[0], rows)


if __name__ == "__main__":
    main()
