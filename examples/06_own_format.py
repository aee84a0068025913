"""Read a scene format of your own: define a Reader, then pass it to warpgs.load_scene or name it on the command line.

The made-up format of this example is a folder with shots.csv, one line per image:

    name, x, y, z, target_x, target_y, target_z, focal_px

A line has the camera's position, the point that the camera looks at (both in any unit, +y down) and the focal length. The
images are in the same folder.

Run without arguments to write a small scene of that format, read it back and check it (a few seconds on a CPU):

    python examples/06_own_format.py

Write the scene to a folder, and fit it from the command line:

    python examples/06_own_format.py --out shots
    warpgs fit shots --reader examples/06_own_format.py:ShotsReader --out run
"""

from __future__ import annotations

import argparse
import csv
import math
import tempfile
from pathlib import Path

import warpgs
from warpgs.io import Lens, Probe, Reader, ReadOptions, SceneFolder, ViewList, view_name

import numpy as np
import torch
from PIL import Image

UP = np.array([0.0, -1.0, 0.0])
"""Upward direction of the format: +y points down, as in an OpenCV camera."""


class ShotsReader(Reader):
    """The shots.csv format."""

    name = "shots"
    description = "shots.csv with images beside it"

    def probe(self, folder: Path) -> Probe | None:
        """Return the file that identifies the format; None if it is missing."""
        return Probe("shots.csv") if (folder / "shots.csv").is_file() else None

    def read(self, folder: Path, options: ReadOptions) -> warpgs.Scene:
        """Return the scene in file coordinates; an invalid line raises a DataError with the line's number."""
        path = folder / "shots.csv"
        scene, views = SceneFolder(folder, options), ViewList(options)
        with path.open(newline="", encoding="utf-8") as file:
            for number, row in enumerate(csv.reader(file), 1):
                where = f"{path}, line {number}"
                name, position, target, focal = parse(row, where)
                image = scene.image(
                    scene.child(folder, name, where),
                    lambda width, height: centred_lens(focal, width, height).checked(where),  # noqa: B023 - called at once
                )
                views.add(view_name(name), warpgs.look_at(position, target, UP), image)
        return self.scene(folder, views.views, views.notes(options))


def parse(row: list[str], where: str) -> tuple[str, np.ndarray, np.ndarray, float]:
    """Return name, position [3], target [3] and focal length [px] of a row.

    Raises:
        DataError: The row is not a name and seven finite numbers, or the camera looks at itself or straight up or down.
    """
    try:
        name, *numbers = (word.strip() for word in row)
        values = np.array([float(word) for word in numbers])
    except ValueError as e:
        raise warpgs.DataError(f"{where}: cannot be understood ({e}); write a name and seven numbers") from e
    if len(values) != 7 or not np.isfinite(values).all():
        raise warpgs.DataError(f"{where}: found {len(values)} numbers; write a name and seven finite numbers")
    position, target = values[:3], values[3:6]
    direction = target - position
    if not np.linalg.norm(np.cross(direction, UP)) > 1e-9:
        raise warpgs.DataError(f"{where}: the camera looks straight up or down, or at itself; move its target")
    return name, position, target, float(values[6])


def centred_lens(focal: float, width: int, height: int) -> Lens:
    """Return a pinhole lens whose principal point is the middle of the image; all arguments in px."""
    return Lens(np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]]), width, height)


def blobs(count: int = 300) -> warpgs.Gaussians:
    """Return coloured Gaussians in a box in front of the cameras, in file units."""
    generator = torch.Generator().manual_seed(0)
    return warpgs.Gaussians(
        means=4 * torch.rand(count, 3, generator=generator) + torch.tensor([-2.0, -2.0, 3.0]),
        quats=torch.randn(count, 4, generator=generator),
        log_scales=torch.full((count, 3), -1.5) + 0.3 * torch.randn(count, 3, generator=generator),
        logit_opacities=torch.full((count,), 1.5),
        sh=torch.randn(count, 1, 3, generator=generator),
    )


def render(viewmat: np.ndarray, K: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return the image of the Gaussians, [height, width, 3] from 0 to 1, for camera_from_world [4, 4] in file units."""
    camera = warpgs.Camera(
        torch.as_tensor(viewmat, dtype=torch.float32), torch.as_tensor(K, dtype=torch.float32), width, height
    )
    image: np.ndarray = warpgs.rasterize(blobs(), camera).rgb.clamp(0, 1).numpy()
    return image


def write_shots(folder: Path, count: int = 8, width: int = 64, height: int = 48) -> None:
    """Write ``count`` images of ``width`` x ``height`` px in the shots.csv format, with cameras from left to right."""
    folder.mkdir(parents=True, exist_ok=True)
    focal, lines = 0.95 * width, []
    for i, x in enumerate(np.linspace(-1.6, 1.6, count).round(6)):
        position, target = np.array([x, 0.2 * x * x - 0.5, 0.0]).round(6), np.array([0.4 * x, 0.0, 5.0]).round(6)
        rgb = render(warpgs.look_at(position, target, UP), centred_lens(focal, width, height).K, width, height)
        Image.fromarray((255 * rgb).round().astype(np.uint8)).save(folder / f"shot{i}.png")
        lines.append(", ".join([f"shot{i}.png", *(f"{v:.6f}" for v in (*position, *target, focal))]))
    (folder / "shots.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")


def check(scene: warpgs.Scene) -> float:
    """Render every view again from the pose that was read.

    Returns:
        The smallest PSNR [dB] between image and rendering: about 59 dB, from rounding to 8 bits, if position, direction,
        focal length and axes are right.
    """
    n, worst = scene.normalization, math.inf
    for view in scene.views:
        viewmat = np.array(view.camera.viewmat)
        # back from scene units to file units
        viewmat[:3, 3] = viewmat[:3, 3] / n.scale - viewmat[:3, :3] @ n.offset
        rgb = render(viewmat, np.asarray(view.camera.K), view.camera.width, view.camera.height)
        worst = min(worst, -10 * math.log10(float(np.mean((rgb - view.image) ** 2))))
    return worst


def main(arguments: list[str] | None = None) -> float:
    """Write, read and check a scene; return the PSNR [dB] of `check`.

    Raises:
        SystemExit: The poses that were read do not fit the images.
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="folder to keep the scene in; default: a temporary folder")
    out = parser.parse_args(arguments).out
    with tempfile.TemporaryDirectory() as temporary:
        folder = out or Path(temporary)
        write_shots(folder)
        scene = warpgs.load_scene(folder, reader=ShotsReader())
        psnr = check(scene)
    if psnr < 50:
        raise SystemExit(f"the poses that were read do not fit the images: {psnr:.1f} dB; at least 50 dB are expected")
    print(f"{scene.format}: {len(scene.views)} views read; rendered again, they equal their images to {psnr:.1f} dB")
    return psnr


if __name__ == "__main__":
    main()
