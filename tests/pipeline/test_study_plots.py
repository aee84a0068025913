"""The plot of a study and its figure: every number is shown, nothing leaves its frame, crops lie where pictures differ."""

import io
import math
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

from warpgs.pipeline.study.tables import BETTER, UNDECIDED, WORSE, Metric, Row, Table, forest, paired_difference
from warpgs.report.images import BOXES, Cell, Strip, crops, disagreement, sheet

SVG = "{http://www.w3.org/2000/svg}"


def row(name, *pairs, base=False, metric="m"):
    return Row(name, {}, {} if base else {metric: paired_difference(list(pairs), [0.0] * len(pairs))})


def table(upwards=True, title="t"):
    rows = (row("a", base=True), row("b", 0.9, 1.0, 1.1), row("c", -0.9, -1.0, -1.1), row("d", -1.0, 1.0))
    return Table(title, "a", (Metric("m", "PSNR", upwards, 2),), rows)


def test_forest_draws_every_seed_and_prints_every_interval():
    """Small dots for seeds, a large one for each mean, words for the ends; all inside the frame."""
    root = ElementTree.fromstring(forest(table(title="t <&>")))
    width, height = (float(root.get(k)) for k in ("width", "height"))
    circles = root.findall(f"{SVG}circle")
    small, large = ([c for c in circles if c.get("r") == r] for r in ("2.8", "5.5"))
    assert len(small) == 8 and len(large) == 3
    assert all(0 < float(c.get("cx")) < width and 0 < float(c.get("cy")) < height for c in circles)
    words = [t.text for t in root.findall(f"{SVG}text")]
    d = paired_difference([0.9, 1.0, 1.1], [0, 0, 0])
    assert f"+1.00  [{d.low:+.2f}, {d.high:+.2f}]" in words and {"a", "b", "c", "d", "the base", "t <&>"} <= set(words)
    xs = [float(c.get("cx")) for c in large]
    assert xs[1] < xs[2] < xs[0] and xs[0] - xs[2] == pytest.approx(xs[2] - xs[1], abs=0.2)


@pytest.mark.parametrize("upwards,colors", [(True, [BETTER, WORSE, UNDECIDED]), (False, [WORSE, BETTER, UNDECIDED])])
def test_forest_colours_follow_the_direction(upwards, colors):
    """More PSNR is better, more LPIPS is worse, and what the interval does not decide is neither."""
    root = ElementTree.fromstring(forest(table(upwards)))
    assert [c.get("fill") for c in root.findall(f"{SVG}circle") if c.get("r") == "5.5"] == colors


def test_forest_of_one_seed_and_of_none():
    """Without an interval the dot stands alone; a metric that nobody measured has no panel."""
    metrics = Metric("m", "PSNR", True, 2), Metric("n", "LPIPS", False, 3)
    one = Row("b", {}, row("b", 0.5).differences | row("b", metric="n").differences)
    root = ElementTree.fromstring(forest(Table("t", "a", metrics, (row("a", base=True), one))))
    words = [t.text for t in root.findall(f"{SVG}text")]
    assert "+0.50" in words and not any("LPIPS" in w for w in words)
    none = Table("t", "a", metrics[1:], (row("a", base=True), row("b", metric="n")))
    assert "no pair of runs to compare" in forest(none)


def test_crops_find_where_pictures_differ():
    """The largest disagreement first, the next one beside it, none overlapping."""
    truth = np.zeros((40, 60, 3), np.float32)
    a, b = truth.copy(), truth.copy()
    a[30:36, 44:54] = 0.9
    b[4:10, 4:14] = 0.5
    values = disagreement([a, b, truth], truth)
    assert values[32, 50] == pytest.approx(0.9) and values[5, 5] == pytest.approx(0.5) and values[20, 20] == 0
    assert np.allclose(disagreement([a], truth), a[..., 0])
    (x0, y0), (x1, y1) = crops(values, 12, 8, 2)
    assert x0 <= 44 and x0 + 12 >= 54 and y0 <= 30 and y0 + 8 >= 36
    assert x1 <= 4 and x1 + 12 >= 14 and y1 <= 4 and y1 + 8 >= 10


def test_crops_of_equal_pictures_and_of_small_ones():
    """Nothing differs: the middle. Windows larger than the picture: one, the whole."""
    assert crops(np.zeros((20, 30)), 10, 8, 1) == [(10, 6)]
    assert crops(np.ones((6, 5)), 9, 9, 3) == [(0, 0)]
    many = crops(np.random.default_rng(0).random((20, 20)), 10, 10, 9)
    assert 1 <= len(many) <= 4
    assert all(abs(a - c) >= 10 or abs(b - d) >= 10 for i, (a, b) in enumerate(many) for c, d in many[:i])


def test_sheet_shows_every_picture_and_its_crops():
    """Columns of one width; a flat picture keeps its colour; boxes and frames have the colours of their crop."""
    colors = [(0.2, 0.4, 0.6), (0.8, 0.1, 0.3), (0.5, 0.5, 0.1)]
    cells = tuple(Cell(np.full((30, 40, 3), c, np.float32), f"{i}.00 dB") for i, c in enumerate(colors))
    data = sheet(["a", "b" * 90, "photograph"], [Strip("scene, view", cells, ((2, 3, 8, 6), (20, 10, 8, 6)))] * 2)
    image = np.array(Image.open(io.BytesIO(data)))
    assert image.dtype == np.uint8 and image.shape[2] == 3 and image.shape[1] <= 2600
    areas = [int((image == np.round(np.array(c) * 255).astype(np.uint8)).all(-1).sum()) for c in colors]
    assert min(areas) > 0.9 * max(areas) > 0
    assert all((image == box).all(-1).sum() > 100 for box in BOXES[:2])
    # what is left of the page is paper, so the labels have not grown over the pictures
    assert (image[:4] == 255).all() and (image[:, :8] == 255).all()


def test_sheet_of_many_columns_stays_printable():
    """Nine settings and the photograph share the width."""
    cell = Cell(np.zeros((24, 32, 3), np.float32), "")
    image = Image.open(io.BytesIO(sheet([str(i) for i in range(10)], [Strip("s", (cell,) * 10, ())])))
    assert image.width <= 2600 and math.isclose(image.width / 10, 256, rel_tol=0.2)
