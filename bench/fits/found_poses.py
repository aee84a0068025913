"""Fits with found poses beside fits with given ones: held-out PSNR of the same photographs, and how far the poses are apart.

SCENE is a COLMAP folder whose poses count as given, such as colmap/fern. Every eighth photograph is held out; of the others
so many train, evenly spaced. Poses are found twice: jointly, of training and held-out photographs, as the given ones were; and
of the training photographs alone, where held-out cameras are the given ones, brought over by the similarity of the training
cameras, with the lens that was found. Since that similarity is not exact, each held-out camera is also scored where its
photograph fits the model best.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import warpgs
from bench.lib import result_file
from bench.lib.arguments import SCENE, parse
from bench.lib.refined_views import refined
from bench.lib.tables import mean_sd
from warpgs.io.images import Lens, load_image
from warpgs.pipeline.runs.request import choose_device
from warpgs.pipeline.train.view_modules.poses import similar_cameras
from warpgs.poses.find import find_poses
from warpgs.scene import Camera, Scene, View

HOLD_EVERY = 8


def chosen(names: list[str], train: int) -> tuple[list[str], list[str]]:
    """Return the names of training and held-out photographs."""
    test, pool = names[::HOLD_EVERY], [n for i, n in enumerate(names) if i % HOLD_EVERY]
    return [pool[round(x)] for x in np.linspace(0, len(pool) - 1, train)], test


def found_scene(images: Path, names: list[str], downscale: int) -> tuple[Scene, dict]:
    """Return the scene found from some photographs, the record of its poses, and the seconds it took in it."""
    with tempfile.TemporaryDirectory() as folder:
        source, began = Path(folder) / "in", time.perf_counter()
        source.mkdir()
        for name in names:
            (source / name).write_bytes((images / name).read_bytes())
        record = find_poses(source, Path(folder) / "scene", threads=2)
        record["seconds"] = time.perf_counter() - began
        return warpgs.load_scene(Path(folder) / "scene", downscale=downscale), record


def brought_over(of: dict[str, View], to: dict[str, View], train: list[str], names: list[str]) -> dict[str, Camera]:
    """Return the named cameras of one scene after the similarity of its training cameras to those of another."""
    cameras, goal = {n: v.camera for n, v in of.items()}, [to[n].camera for n in train]
    return similar_cameras(cameras, [cameras[n] for n in train], goal, names)


def held_out(view: View, camera: Camera, image: Path, found: dict, downscale: int) -> View:
    """Return a held-out view from a camera, seen through the lens that was found: poses and focal length go together."""
    f, width, height = found["focal"], found["width"], found["height"]
    K = np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]])
    loaded = load_image(image, Lens(K, width, height, (found["distortion"], 0.0, 0.0, 0.0)), downscale=downscale)
    return View(view.name, replace(camera, K=loaded.K), loaded.image, loaded.mask)


def errors(of: dict[str, View], to: dict[str, View]) -> dict[str, float]:
    """Return how far cameras are from those of another scene after the similarity: degrees, and parts of the mean distance."""
    names = sorted(of.keys() & to.keys())
    cameras = brought_over(of, to, names, names)
    centers = np.array([to[n].camera.center for n in names])
    spread = np.linalg.norm(centers - centers.mean(0), axis=1).mean()
    cosines = [(np.trace(to[n].camera.viewmat[:3, :3] @ cameras[n].viewmat[:3, :3].T) - 1) / 2 for n in names]
    angles = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    offsets = np.linalg.norm([cameras[n].center - to[n].camera.center for n in names], axis=1) / spread
    return {"degrees": float(np.median(angles)), "degrees_max": float(angles.max()), "offset": float(np.median(offsets))}


def psnr(scene: Scene, train: list[str], test: list[str], preset: str, seed: int, device: str) -> tuple[float, float]:
    """Return the held-out PSNR of one fit [dB], and that with each held-out camera moved to where its photograph fits best."""
    config = replace(warpgs.PRESETS[preset], seed=seed)
    split = f"train={','.join(train)};test={','.join(test)}"
    result = warpgs.fit(scene, config, split=split, device=device, verbose=False)
    options = result.options()
    views = [refined(result.scene_gaussians, v, options) for v in scene.views if v.name in test]
    best = warpgs.evaluate(result.scene_gaussians, views, options)
    return float(result.metrics["test"]["psnr"]), statistics.mean(m.psnr for m in best)


def main() -> None:
    """Measure and write."""
    a = parse(
        __doc__, None, SCENE, train=[17, 6, 3], seeds=[0, 1, 2], preset="quick", downscale=4, device="cpu", out=Path,
    )  # fmt: skip
    given, rows = warpgs.load_scene(a.scene, downscale=a.downscale), []
    reference = {v.name: v for v in given.views}
    for count in a.train:
        train, test = chosen(list(reference), count)
        joint, joint_record = found_scene(a.scene / "images", [*train, *test], a.downscale)
        alone, alone_record = found_scene(a.scene / "images", train, a.downscale)
        mine = {v.name: v for v in alone.views}
        over = brought_over(reference, mine, [n for n in train if n in mine], test)
        (lens,) = alone_record["cameras"]
        tests = [held_out(reference[n], over[n], a.scene / "images" / n, lens, a.downscale) for n in test]
        aligned = replace(alone, views=(*alone.views, *tests))
        for poses, scene, record in (
            ("given", given, None),
            ("joint", joint, joint_record),
            ("aligned", aligned, alone_record),
        ):
            scores = [psnr(scene, train, test, a.preset, seed, a.device) for seed in a.seeds]
            plain, best = ([s[k] for s in scores] for k in (0, 1))
            row = {"poses": poses, "train": count, "held_out": len(test), "psnr": plain, "psnr_cameras_refined": best,
                   "preset": a.preset, "seeds": a.seeds, "downscale": a.downscale}  # fmt: skip
            if record is not None:
                row |= errors({v.name: v for v in (joint if poses == "joint" else alone).views}, reference)
                row |= {k: record[k] for k in ("mean_reprojection_error_px", "points", "seconds")}
                row["registered"] = sum(p["registered"] for p in record["photographs"])
            rows.append(row)
            print(
                f"{count} views, {poses} poses: {mean_sd(plain)} dB; held-out cameras refined: {mean_sd(best)} dB", flush=True
            )
            what = "held-out PSNR with given and with found poses of the same photographs"
            result_file.keep(a.out, what, choose_device(a.device)[0], rows)


if __name__ == "__main__":
    main()
