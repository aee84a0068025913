"""Photographs of the demo's still life, rendered once, and the scene that is found from them."""

import io
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from warpgs.synthetic import raycast
from warpgs.synthetic.demo import camera_path, still_life

WIDTH, HEIGHT = 240, 180
MAKE, MODEL, GPS = 0x010F, 0x0110, 0x8825


def with_exif(image: np.ndarray, orientation: int, film: int = 34) -> bytes:
    """A JPEG file of an RGB image as a phone writes it: turned, with its position, its owner, a maker and a lens."""
    exif = Image.Exif()
    exif[0x0112], exif[MAKE], exif[MODEL], exif[0x013B] = orientation, "ACME", "Phone 7", "Jane Owner"
    exif.get_ifd(GPS).update({1: "N", 2: (48.0, 8.0, 30.0)})
    exif.get_ifd(0x8769)[0xA405] = film
    stored = io.BytesIO()
    Image.fromarray(image).save(stored, "JPEG", quality=95, exif=exif)
    return stored.getvalue()


@pytest.fixture
def sfm():
    pytest.importorskip("pycolmap")


@pytest.fixture(scope="session")
def still_life_views():
    """Cameras and images, uint8 [H, W, 3], of six neighbouring places."""
    shapes, cameras = still_life(0), camera_path(8, WIDTH, HEIGHT)[1:7]
    images = [raycast.render(shapes, raycast.Light(), c.K, c.viewmat, WIDTH, HEIGHT) for c in cameras]
    return cameras, [np.round(255 * i).astype(np.uint8) for i in images]


def write_png(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), image[..., ::-1])


@pytest.fixture(scope="session")
def photographs(still_life_views, tmp_path_factory):
    """Six photographs: two of a phone say where they were taken, one of those lies on its side; one is of another size."""
    folder = tmp_path_factory.mktemp("photographs")
    for i, image in enumerate(still_life_views[1]):
        if i == 2:
            (folder / "2.jpg").write_bytes(with_exif(np.ascontiguousarray(np.rot90(image)), 6))
        elif i == 3:
            write_png(folder / "3.png", cv2.resize(image, (200, 150), interpolation=cv2.INTER_AREA))
        elif i == 5:
            (folder / "5.jpg").write_bytes(with_exif(image, 1))
        else:
            write_png(folder / f"{i}.png", image)
    return folder


@pytest.fixture(scope="session")
def found(photographs, tmp_path_factory):
    pytest.importorskip("pycolmap")
    from warpgs.poses.find import find_poses

    out = tmp_path_factory.mktemp("found") / "scene"
    return out, find_poses(photographs, out, threads=2)


def film(path, frames: int) -> None:
    """Write a video in which every third frame is sharp."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, (96, 64))
    texture = np.random.default_rng(0).integers(0, 255, (64, 96, 3), np.uint8)
    for i in range(frames):
        writer.write(cv2.GaussianBlur(texture, (0, 0), 1 if i % 3 == 1 else 4))
    writer.release()
