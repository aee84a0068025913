"""Plots: the script gets what is to be shown, the legend stands below, and a machine that cannot render is told why."""

import dataclasses
import io

import numpy as np
import pytest
from PIL import Image

from tests.scenes import ring
from warpgs.errors import ResourceError
from warpgs.report import overview as module
from warpgs.report.overview import TRAIN_COLOR, ScenePlot, render_plot


def plot(count: int = 400) -> ScenePlot:
    points = np.random.default_rng(0).normal(size=(count, 3)) * 0.3
    points[0] = 1000
    axes = np.broadcast_to(0.05 * np.eye(3), (count, 3, 3)).copy()
    axes[1] *= 1e6
    up, direction = np.array([0, -1.0, 0]), np.array([1.0, -0.5, -1])
    return ScenePlot(points, np.full((count, 3), 0.5), axes, ring(4), ring(2), up, direction, [("seen by 1", "#ff0000")])


@pytest.fixture
def sent(monkeypatch) -> dict:
    """What the script is given; instead of rendering, the image is gray."""
    found: dict = {}

    def instead(code, source, words, target):
        with np.load(source) as data:
            found.update(data)
        found["words"] = words
        size = module.json.loads(words)["size"]
        Image.new("RGB", size, "gray").save(target, "PNG")
        return True, ""

    monkeypatch.setattr(module, "run_pyvista", instead)
    return found


def test_what_lies_far_outside_is_left_out_and_what_is_huge_is_shrunk(sent):
    data = render_plot(plot(), (400, 300), "black")
    assert len(sent["points"]) == 399 and np.abs(sent["points"]).max() < 2
    lengths = np.linalg.norm(sent["axes"], axis=1)
    assert lengths[0].max() < 0.2 and lengths[1:].min() > 0.03
    with Image.open(io.BytesIO(data)) as image:
        assert image.size == (400, 300)
        strip = np.asarray(image)[-18:].reshape(-1, 3)
    for color in (TRAIN_COLOR, "#ff0000"):
        assert (strip == [int(color[i : i + 2], 16) for i in (1, 3, 5)]).all(1).any()


def test_without_a_legend_the_plot_fills_the_image(sent):
    data = render_plot(dataclasses.replace(plot(), train=[], test=[], legend=[], axes=None), (200, 100), "white")
    with Image.open(io.BytesIO(data)) as image:
        assert image.size == (200, 100) and (np.asarray(image) == 128).all()
    assert "axes" not in sent


def test_a_machine_that_cannot_render_is_told_what_to_install(monkeypatch):
    monkeypatch.setattr(module, "run_pyvista", lambda *_: (False, "pyvista ended with code -11"))
    with pytest.raises(ResourceError, match=r"no plot: pyvista ended with code -11.*libegl1"):
        render_plot(plot(), (200, 100), "white")
