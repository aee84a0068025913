"""Runs on objects cut out: scores of opacity, transparent renders, films over a colour, and what the run folder holds."""

import dataclasses
import json

import cv2
import numpy as np
import pytest

from tests.io import scenes
from warpgs.app.cli import main
from warpgs.pipeline.films.film import render_path
from warpgs.pipeline.metrics import scores
from warpgs.pipeline.metrics.scores import score, summarize
from warpgs.pipeline.run import folder as schemas
from warpgs.pipeline.run.folder import open_run
from warpgs.pipeline.run.results import score_line
from warpgs.report.images import png, straight_alpha
from warpgs.scene import Camera, View


def view(alpha=None, mask=None):
    """Return a gray view of 12 x 16 px with an opacity and a mask."""
    camera = Camera(np.eye(4), np.eye(3), 16, 12)
    return View("a.png", camera, np.full((12, 16, 3), 0.4, np.float32), mask, alpha=alpha)


def test_scores_of_opacity_are_over_the_pixels_of_each_kind():
    """Empty, object and edge have an error of their own; masked pixels do not count."""
    alpha = np.zeros((12, 16), np.float32)
    alpha[:, 4:12], alpha[:, 12:] = 1, 0.6
    mask = np.ones((12, 16), bool)
    mask[0] = False
    rendered = np.where(alpha == 1, np.float32(0.9), np.float32(0.25))
    rendered[0] = 0.5
    image = np.full((12, 16, 3), 102 / 255, np.float32)
    image[:, :4] += 51 / 255
    image[0] = 0
    m = score(view(alpha, mask), image, alpha=rendered)
    assert m.opacity["alpha_empty"] == pytest.approx(0.25) and m.opacity["alpha_object"] == pytest.approx(0.9)
    assert m.opacity["psnr_whole"] == pytest.approx(10 * np.log10(4 * 25)) and m.opacity["psnr_foreground"] == np.inf
    assert score(view(), image, alpha=rendered).opacity == {} == score(view(alpha), image).opacity
    assert set(m.opacity) == set(scores.ALPHA_VARIANTS) == set(schemas.OPACITY)


def test_means_are_over_the_views_that_have_such_pixels():
    whole, half = np.ones((12, 16), np.float32), np.ones((12, 16), np.float32)
    half[:, :8] = 0
    image = np.full((12, 16, 3), 0.5, np.float32)
    rows = [score(view(a), image, alpha=np.full((12, 16), r, np.float32)) for a, r in ((whole, 1.0), (half, 0.5), (None, 0.1))]
    means = summarize(rows)
    assert means["alpha_empty"] == 0.5 and means["alpha_object"] == 0.75
    line = score_line(means)
    assert ", PSNR of the foreground 19.83 dB" in line and ", alpha where empty 0.500, alpha in the object 0.750" in line
    assert "alpha" not in score_line(summarize(rows[2:]))


def test_straight_alpha_shows_the_image_again_over_any_background():
    rng = np.random.default_rng(0)
    colors, alpha = rng.uniform(0, 1, (6, 7, 3)).astype(np.float32), rng.uniform(0, 1, (6, 7)).astype(np.float32)
    alpha[0] = 0
    over = {b: colors * alpha[..., None] + (1 - alpha[..., None]) * np.float32(b) for b in ((0, 0, 0), (1, 0.5, 0.2))}
    for background, image in over.items():
        made = straight_alpha(image, alpha, background)
        assert (made[0] == 0).all()
        np.testing.assert_allclose(made[1:, :, :3] * alpha[1:, :, None], over[0, 0, 0][1:], atol=1e-5)
    decoded = cv2.imdecode(np.frombuffer(png(made), np.uint8), cv2.IMREAD_UNCHANGED)[..., [2, 1, 0, 3]]
    np.testing.assert_array_equal(decoded, np.round(made * 255))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A short run on a Blender scene."""
    folder = tmp_path_factory.mktemp("cut_out")
    scenes.write_blender(folder / "scene")
    flags = ["--init.source", "random", "--init.random-count", "60", "--preset", "3dgs", "--steps", "3", "--device", "cpu"]
    flags += ["--split", "every:8"]
    assert main(["fit", str(folder / "scene"), "--out", str(folder / "run"), *flags]) == 0
    return folder / "run"


def test_metrics_config_and_report_speak_of_opacity(run):
    metrics, record = (json.loads((run / n).read_text()) for n in ("metrics.json", "config.json"))
    assert set(schemas.OPACITY) <= set(metrics["test"]) & set(metrics["views"][0]) & set(metrics["variants"])
    assert metrics["test"]["psnr"] == metrics["test"]["psnr_whole"] and record["transparent"] is True
    schemas.METRICS(metrics, "")
    assert "alpha where empty" in (run / "report.html").read_text()
    assert open_run(run, "cpu").transparent


def test_renders_are_transparent_unless_a_colour_is_named(run, tmp_path, capsys):
    """Over the background of the fit the transparent image is the opaque one; films have the colour."""
    stored = open_run(run, "cpu")
    images = {}
    for name in ("auto", "white", "#0000ff"):
        out = tmp_path / name.strip("#")
        assert main(["render", str(run), "--out", str(out), "--path", "views", "--device", "cpu", "--background", name]) == 0
        file = sorted(out.rglob("*.png"))[0]
        images[name] = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)[..., ::-1] / 255.0
    assert [i.shape[2] for i in images.values()] == [4, 3, 3]
    alpha, colors = images["auto"][..., :1], images["auto"][..., 1:]  # reversed: ARGB
    for name, background in (("white", [1, 1, 1]), ("#0000ff", [0, 0, 1])):
        np.testing.assert_allclose(alpha * colors + (1 - alpha) * background, images[name], atol=2.5 / 255)
    assert main(["render", str(run), "--out", str(tmp_path / "x"), "--background", "mean"]) == 2
    assert "expected auto, black, white" in capsys.readouterr().err
    opaque = dataclasses.replace(stored, transparent=False)
    file, film = render_path(opaque, [stored.scene_cameras[stored.train[0]]], out=tmp_path / "opaque")
    assert cv2.imread(str(file), cv2.IMREAD_UNCHANGED).shape[2] == 3 and film.name == "film.mp4"
