"""Images of a report: sheets with labels, and what they are stored as."""

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest

from warpgs.files import write_bytes
from warpgs.report.images import (
    CONTACT_GAP,
    CONTACT_HEAD,
    CONTACT_MARGIN,
    CONTACT_PAPER,
    GRAY,
    TITLE_SIZE,
    Tile,
    channel_mean,
    colored,
    contact_sheet,
    depth_map,
    error_map,
    png,
    side_by_side,
    webp,
)

TOP = CONTACT_MARGIN + TITLE_SIZE + 18


def corner(index, width, height, columns):
    x, y = CONTACT_MARGIN + index % columns * (width + CONTACT_GAP), index // columns * (CONTACT_HEAD + height + CONTACT_GAP)
    return x, TOP + CONTACT_HEAD + y


def test_tiles_keep_their_pixels_and_order():
    """At their own size images on the sheet are unchanged, and maps have the colours of their map."""
    rng = np.random.default_rng(0)
    image = np.round(rng.random((150, 200, 3)) * 255).astype(np.float32) / 255
    maps = [rng.random((150, 200), np.float32) for _ in range(3)]
    tiles = [Tile("photo", image), *(Tile(f"map {i}", m, "VIRIDIS") for i, m in enumerate(maps))]
    sheet = contact_sheet("a view", ["one sentence"], tiles, columns=3, tile_width=200)
    height = TOP + 2 * (CONTACT_HEAD + 150) + CONTACT_GAP + CONTACT_MARGIN
    assert sheet.shape == (height, 2 * CONTACT_MARGIN + 3 * 200 + 2 * CONTACT_GAP, 3) and sheet.dtype == np.float32
    for i, wanted in enumerate([image, *(colored(m, "VIRIDIS") for m in maps)]):
        x, y = corner(i, 200, 150, 3)
        np.testing.assert_allclose(sheet[y : y + 150, x : x + 200], wanted, atol=0.51 / 255)

    # labels and text have ink in their places and paper around them; longer text has more
    def ink(part):
        return int((np.abs(part - np.float32(CONTACT_PAPER) / 255).max(-1) > 0.1).sum())

    tiles = [Tile("image", np.zeros((60, 300, 3))), Tile("map", np.zeros((60, 300)))]
    short = contact_sheet("title", ["Depth: none."], tiles, columns=2, tile_width=300)
    long = contact_sheet("title", ["Depth: none.", "Semantics: saliency and edges."], tiles, columns=2, tile_width=300)
    (ax, ay), (bx, by), (cx, cy) = (corner(i, 300, 60, 2) for i in range(3))
    for x, y in ((ax, ay), (bx, by)):
        label = short[y - CONTACT_HEAD : y, x:]
        assert ink(label[:, :100]) > 50 and ink(label[:, 200:300]) == 0
    assert ink(short[:TOP, CONTACT_MARGIN:]) > 50 and ink(short[:, :CONTACT_MARGIN]) == 0 == ink(short[:, -CONTACT_MARGIN:])
    assert ink(long[cy + 4 :, cx:]) > ink(short[cy + 4 :, cx:]) > 50
    values = np.array([[0, 0.5], [1, 9]], np.float32).repeat(60, 0).repeat(60, 1)
    sheet = contact_sheet("t", [], [Tile("m", values)], columns=2, tile_width=120)
    x, y = corner(0, 120, 120, 2)
    wanted = colored(np.array([[0, 0.5], [1, 1]]), "INFERNO")
    np.testing.assert_allclose(sheet[y + 30 : y + 120 : 60, x + 30 : x + 120 : 60], wanted, atol=0.01)


def decode(data):
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


def test_png_and_webp_decode_to_the_pixels_and_images_side_by_side_keep_them(tmp_path):
    """A smooth WebP is off by a few of 255; a wide one is reduced in proportion; threads may write one file."""
    image = np.random.default_rng(0).uniform(-0.2, 1.2, (9, 13, 3)).astype(np.float32)
    data = png(image)
    assert data.startswith(b"\x89PNG")
    np.testing.assert_array_equal(decode(data), np.round(np.clip(image, 0, 1) * 255).astype(np.uint8))
    assert decode(png(np.array([[[1.0, 0.5, 0.0]]])))[0, 0].tolist() == [255, 128, 0]
    y, x = np.mgrid[0:60, 0:90] / 90
    image = np.stack([x, y, 0.5 + 0.4 * np.sin(9 * x * y)], 2)
    data = webp(image)
    assert data[:4] == b"RIFF" and data[8:12] == b"WEBP" and len(data) < len(png(image)) / 4
    assert np.abs(decode(data) - 255 * image).mean() < 3
    assert decode(webp(png(image), width=45)).shape == (30, 45, 3)
    assert decode(webp(np.zeros((3, 4000, 3)), width=100)).shape == (1, 100, 3)
    images = [np.full((5, w, 3), v, np.float32) for w, v in ((4, 0.1), (6, 0.2))]
    row = side_by_side(images, gap=2)
    assert row.shape == (5, 12, 3) and (row[:, :4] == images[0]).all() and (row[:, 6:] == images[1]).all()
    assert (row[:, 4:6] == 1).all()
    contents = [bytes([i]) * 50_000 for i in range(8)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda c: [write_bytes(tmp_path / "a.png", c) for _ in range(20)], contents))
    assert (tmp_path / "a.png").read_bytes() in contents and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_mean_over_channels_has_the_bits_of_numpy(kind):
    image = np.random.default_rng(0).uniform(-0.2, 1.2, (40, 70, 3)).astype(kind)
    for own in (image, image[:, ::-1], image.transpose(1, 0, 2), image[5:6]):
        assert channel_mean(own).dtype == kind
        np.testing.assert_array_equal(channel_mean(own), own.mean(-1))


def test_error_map_is_brighter_with_more_and_depth_map_warm_near_cold_far_and_gray_where_nothing_is():
    reference = np.full((1, 5, 3), 0.4, np.float32)
    image = reference + np.array([0, 0.05, 0.15, 0.3, 0.5], np.float32)[None, :, None]
    brightness = error_map(image, reference).sum(-1)[0]
    assert brightness[0] < 0.1 and (np.diff(brightness[:4]) > 0).all() and brightness[4] == brightness[3]
    np.testing.assert_array_equal(error_map(reference - 0.15, reference), error_map(reference + 0.15, reference))
    depth = np.linspace(1, 5, 50, dtype=np.float32)[None].repeat(2, 0)
    alpha = np.ones_like(depth)
    alpha[1, 10:20] = 0.2
    depth[1, 30] = 0
    colors = depth_map(depth, alpha)
    near, far = colors[0, 0], colors[0, -1]
    assert near[0] > near[2] and far[2] > far[0]
    assert (depth_map(np.zeros((3, 4)), np.zeros((3, 4))) == GRAY).all()
    wall = depth_map(np.full((3, 4), 2.0), np.ones((3, 4)))
    assert np.isfinite(wall).all() and (wall == wall[0, 0]).all()
    assert (colors[1, 10:20] == GRAY).all() and (colors[1, 30] == GRAY).all() and not (colors[0] == GRAY).all(-1).any()
