from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np

from warpgs.files import write_bytes
from warpgs.report.images import GRAY, depth_map, error_map, png, side_by_side, webp


def decode(data):
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


def test_png_decodes_to_the_rounded_pixels_in_rgb_order():
    image = np.random.default_rng(0).uniform(-0.2, 1.2, (9, 13, 3)).astype(np.float32)
    data = png(image)
    assert data.startswith(b"\x89PNG")
    np.testing.assert_array_equal(decode(data), np.round(np.clip(image, 0, 1) * 255).astype(np.uint8))
    assert decode(png(np.array([[[1.0, 0.5, 0.0]]])))[0, 0].tolist() == [255, 128, 0]


def test_error_map_is_black_without_error_and_brighter_with_more():
    reference = np.full((1, 5, 3), 0.4, np.float32)
    image = reference + np.array([0, 0.05, 0.15, 0.3, 0.5], np.float32)[None, :, None]
    brightness = error_map(image, reference).sum(-1)[0]
    assert brightness[0] < 0.1 and (np.diff(brightness[:4]) > 0).all() and brightness[4] == brightness[3]
    np.testing.assert_array_equal(error_map(reference - 0.15, reference), error_map(reference + 0.15, reference))


def test_depth_map_is_warm_near_cold_far_and_gray_where_nothing_is():
    depth = np.linspace(1, 5, 50, dtype=np.float32)[None].repeat(2, 0)
    alpha = np.ones_like(depth)
    alpha[1, 10:20] = 0.2
    depth[1, 30] = 0
    colors = depth_map(depth, alpha)
    near, far = colors[0, 0], colors[0, -1]
    assert near[0] > near[2] and far[2] > far[0]
    assert (colors[1, 10:20] == GRAY).all() and (colors[1, 30] == GRAY).all() and not (colors[0] == GRAY).all(-1).any()


def test_depth_map_of_nothing_and_of_a_wall():
    assert (depth_map(np.zeros((3, 4)), np.zeros((3, 4))) == GRAY).all()
    wall = depth_map(np.full((3, 4), 2.0), np.ones((3, 4)))
    assert np.isfinite(wall).all() and (wall == wall[0, 0]).all()


def test_side_by_side_keeps_every_pixel():
    images = [np.full((5, w, 3), v, np.float32) for w, v in ((4, 0.1), (6, 0.2), (3, 0.3))]
    row = side_by_side(images, gap=2)
    assert row.shape == (5, 17, 3)
    assert (row[:, :4] == images[0]).all() and (row[:, 6:12] == images[1]).all() and (row[:, 14:] == images[2]).all()
    assert (row[:, 4:6] == 1).all()


def test_threads_may_write_one_file(tmp_path):
    """The file is one of those written, complete, and no other file is left."""
    contents = [bytes([i]) * 50_000 for i in range(8)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda c: [write_bytes(tmp_path / "a.png", c) for _ in range(20)], contents))
    assert (tmp_path / "a.png").read_bytes() in contents and len(list(tmp_path.iterdir())) == 1


def test_webp_is_small_and_shows_the_same():
    """A smooth image is off by a few of 255; a wide one is reduced in proportion; a file's contents count as an image."""
    y, x = np.mgrid[0:60, 0:90] / 90
    image = np.stack([x, y, 0.5 + 0.4 * np.sin(9 * x * y)], 2)
    data = webp(image)
    assert data[:4] == b"RIFF" and data[8:12] == b"WEBP" and len(data) < len(png(image)) / 4
    assert np.abs(decode(data) - 255 * image).mean() < 3
    assert decode(webp(png(image), width=45)).shape == (30, 45, 3)
    assert decode(webp(np.zeros((3, 4000, 3)), width=100)).shape == (1, 100, 3)
