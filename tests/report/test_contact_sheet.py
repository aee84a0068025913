"""Sheets of labelled images: every tile in its place, unharmed, with its label, range and text."""

import numpy as np

from warpgs.report.images import (
    CONTACT_GAP,
    CONTACT_HEAD,
    CONTACT_MARGIN,
    CONTACT_PAPER,
    TITLE_SIZE,
    Tile,
    colored,
    contact_sheet,
)

TOP = CONTACT_MARGIN + TITLE_SIZE + 18


def corner(index, width, height, columns):
    """Return the left upper corner x, y of a tile's image [px]."""
    return CONTACT_MARGIN + index % columns * (width + CONTACT_GAP), TOP + CONTACT_HEAD + index // columns * (
        CONTACT_HEAD + height + CONTACT_GAP
    )


def test_tiles_keep_their_pixels_and_order():
    """At their own size images on the sheet are unchanged, and maps have the colours of their map."""
    rng = np.random.default_rng(0)
    image = np.round(rng.random((150, 200, 3)) * 255).astype(np.float32) / 255
    maps = [rng.random((150, 200), np.float32) for _ in range(3)]
    tiles = [Tile("photo", image), *(Tile(f"map {i}", m, "VIRIDIS") for i, m in enumerate(maps))]
    sheet = contact_sheet("a view", ["one sentence"], tiles, columns=3, tile_width=200)
    assert (
        sheet.shape
        == (TOP + 2 * (CONTACT_HEAD + 150) + CONTACT_GAP + CONTACT_MARGIN, 2 * CONTACT_MARGIN + 3 * 200 + 2 * CONTACT_GAP, 3)
        and sheet.dtype == np.float32
    )
    for i, wanted in enumerate([image, *(colored(m, "VIRIDIS") for m in maps)]):
        x, y = corner(i, 200, 150, 3)
        np.testing.assert_allclose(sheet[y : y + 150, x : x + 200], wanted, atol=0.51 / 255)


def test_labels_ranges_and_text_are_drawn_on_paper():
    """Labels, colour bars and text have ink in their places and paper around them; longer text has more."""

    def ink(part):
        return int((np.abs(part - np.float32(CONTACT_PAPER) / 255).max(-1) > 0.1).sum())

    tiles = [Tile("image", np.zeros((60, 300, 3))), Tile("map", np.zeros((60, 300)), largest=2.5)]
    short = contact_sheet("title", ["Depth: none."], tiles, columns=2, tile_width=300)
    long = contact_sheet("title", ["Depth: none.", "Semantics: saliency and edges."], tiles, columns=2, tile_width=300)
    (ax, ay), (bx, by), (cx, cy) = (corner(i, 300, 60, 2) for i in range(3))
    assert (
        ink(short[ay - CONTACT_HEAD : ay, ax : ax + 100]) > 50 and ink(short[ay - CONTACT_HEAD : ay, ax + 200 : ax + 300]) == 0
    )
    assert ink(short[by - CONTACT_HEAD : by, bx + 200 : bx + 300]) > 200, "a colour bar with its range"
    assert ink(short[:TOP, CONTACT_MARGIN:]) > 50 and ink(short[:, :CONTACT_MARGIN]) == 0 == ink(short[:, -CONTACT_MARGIN:])
    assert ink(long[cy + 4 :, cx:]) > ink(short[cy + 4 :, cx:]) > 50


def test_a_range_above_one_is_scaled():
    values = np.array([[0, 1.25], [2.5, 9]], np.float32).repeat(60, 0).repeat(60, 1)
    sheet = contact_sheet("t", [], [Tile("m", values, "INFERNO", 2.5)], columns=2, tile_width=120)
    x, y = corner(0, 120, 120, 2)
    wanted = colored(np.array([[0, 0.5], [1, 1]]), "INFERNO")
    np.testing.assert_allclose(sheet[y + 30 : y + 120 : 60, x + 30 : x + 120 : 60], wanted, atol=0.01)
