"""Poses by SIFT and by the network of `--matcher`: photographs with a pose, and errors of rotations and focal length.

DATA has the folders colmap/fern, llff/horns, fox and templeSparseRing. A set is SCENE:COUNT:CHANGE: evenly spaced photographs
of a scene, optionally darkened, blurred or turned (dark, blur, turn). Errors are those of `bench.lib.pose_errors` against the
scene's own cameras; "right" counts photographs with an error of rotation of at most 5 degrees.
"""

from __future__ import annotations

import json
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import warpgs
from bench.lib import result_file
from bench.lib.arguments import parse
from bench.lib.pose_errors import angles, errors
from warpgs.errors import WarpgsError
from warpgs.geometry import matmul
from warpgs.poses.find import find_poses
from warpgs.scene import View

SCENES = {
    "fern": ("colmap/fern", "colmap/fern/images"), "horns": ("llff/horns", "llff/horns/images_8"), "fox": ("fox", "fox/images"),
    "temple": ("templeSparseRing", "templeSparseRing"),
}  # fmt: skip
SETS = [
    "fern:3", "fern:6", "fern:20", "horns:3", "horns:6", "horns:20", "fox:8", "fox:20", "temple:16", "temple:8",
    "fern:6:dark", "horns:6:dark", "temple:16:dark", "fern:6:blur", "horns:6:blur", "temple:16:blur", "fern:6:turn",
    "horns:6:turn", "temple:16:turn",
]  # fmt: skip
LIGHT, NOISE = 0.01, 0.004
"""Brightness of a darkened photograph as a fraction of the original's, and standard deviation of its noise, both linear."""
BLUR = 4.5 / 504
"""Standard deviation of a blurred photograph's blur, in longer sides."""
RIGHT = 5.0
"""Largest error of the rotation [degrees] of a photograph that counts as right."""
QUARTER = np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
"""Rotation of a camera whose image is turned once by `numpy.rot90`."""


def changed(image: np.ndarray, change: str, number: int) -> np.ndarray:
    """Return a photograph, uint8 [H, W, 3], darkened, blurred or turned by quarters; ``number`` is its seed and turns."""
    import cv2

    if change == "dark":
        linear = LIGHT * (image / 255.0) ** 2.2 + np.random.default_rng(number).normal(0, NOISE, image.shape)
        return np.round(255 * np.clip(linear, 0, 1) ** (1 / 2.2)).astype(np.uint8)
    if change == "blur":
        return cv2.GaussianBlur(image, (0, 0), BLUR * max(image.shape))
    return np.ascontiguousarray(np.rot90(image, number % 4)) if change == "turn" else image


def chosen(reference: dict[str, View], count: int, change: str) -> dict[str, View]:
    """Return evenly spaced views, by the names of their files without suffix; cameras turn with their photographs."""
    names, found = sorted(reference), {}
    for k, i in enumerate(np.linspace(0, len(names) - 1, count)):
        view = reference[names[round(i)]]
        viewmat = view.camera.viewmat
        for _ in range(k % 4 if change == "turn" else 0):
            viewmat = matmul(QUARTER, viewmat)
        found[names[round(i)]] = replace(view, camera=replace(view.camera, viewmat=viewmat))
    return found


def row(data: Path, name: str, matcher: Path | None) -> dict:
    """Return the figures of one set with one kind of matches."""
    import cv2

    scene, count, change = [*name.split(":"), ""][:3]
    folder, images = (data / p for p in SCENES[scene])
    reference = {Path(v.name).stem: v for v in warpgs.load_scene(folder, max_side=0).views}
    views = chosen(reference, int(count), change)
    files = {p.stem: p for p in sorted(images.iterdir()) if p.suffix.lower() in (".png", ".jpg")}
    found = {"set": name, "matcher": "SIFT" if matcher is None else matcher.name, "photographs": len(views)}
    with tempfile.TemporaryDirectory() as work:
        source = Path(work) / "photographs"
        source.mkdir()
        for i, stem in enumerate(views):
            cv2.imwrite(str(source / f"{stem}.png"), changed(cv2.imread(str(files[stem])), change, i))
        began = time.perf_counter()
        try:
            record = find_poses(source, Path(work) / "scene", threads=2, matcher=matcher)
        except WarpgsError as e:
            return found | {"registered": 0, "right": 0, "seconds": time.perf_counter() - began, "error": str(e)[:200]}
        seconds = time.perf_counter() - began
        posed = {Path(v.name).stem: v for v in warpgs.load_scene(Path(work) / "scene", max_side=0).views}
    camera, lens = next(iter(views.values())).camera, record["cameras"][0]
    focal = lens["focal"] / max(lens["width"], lens["height"]) / float(camera.K[0, 0] / max(camera.width, camera.height))
    off = angles(posed, views)
    return found | {
        "registered": len(posed), "right": sum(a < RIGHT for a in off), "degrees_mean": statistics.mean(off),
        **errors(posed, views), "focal_error": focal - 1, "points": record["points"], "method": record["method"],
        "mean_reprojection_error_px": record["mean_reprojection_error_px"], "seconds": seconds,
    }  # fmt: skip


def main() -> None:
    """Find the poses of each set in both ways; rows that a result file has are kept."""
    a = parse(__doc__, None, {"data": Path}, need=("matcher", "out"), sets=SETS, matcher=Path, out=Path)
    rows = json.loads(a.out.read_text("utf-8"))["rows"] if a.out.is_file() else []
    for name in a.sets:
        for matcher in (None, a.matcher):
            title = "SIFT" if matcher is None else matcher.name
            if not any(r["set"] == name and r["matcher"] == title for r in rows):
                rows.append(row(a.data, name, matcher))
                print(json.dumps(rows[-1]), flush=True)
                result_file.keep(a.out, "poses by SIFT and by a network's matches", torch.device("cpu"), rows)


if __name__ == "__main__":
    main()
