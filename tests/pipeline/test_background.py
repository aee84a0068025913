"""The colour behind a scene: named, chosen, shown by renders, and kept by the run folder."""

import dataclasses
import json

import numpy as np
import pytest

from tests.io import scenes
from warpgs.app.cli import main
from warpgs.errors import UsageError
from warpgs.io.load import load_scene
from warpgs.pipeline.run.commands import scene_of
from warpgs.pipeline.run.folder import open_run
from warpgs.pipeline.train.presets import PRESETS
from warpgs.pipeline.train.schedule import choose_background, color_of, over_background
from warpgs.pipeline.train.settings import FitConfig


@pytest.mark.parametrize(
    "text,color",
    [("black", (0, 0, 0)), ("white", (1, 1, 1)), ("#ff8000", (1, 128 / 255, 0)), ("0.25,1,.5", (0.25, 1, 0.5)),
     ("auto", None), ("mean", None), ("scene", None)],
)  # fmt: skip
def test_colours_by_name_and_by_number(text, color):
    assert color_of(text) == color and FitConfig(background=text).background == text


@pytest.mark.parametrize("text", ["", "grey", "#fff", "#gggggg", "1,1", "1,1,2", "nan,0,0", "1.5,0,0", "-0.1,0,0", "1e-1,0,0"])
def test_what_is_no_colour_is_refused(text):
    with pytest.raises(UsageError, match=r"is not a colour: give auto, mean, scene, black, white, #rrggbb, or r,g,b"):
        FitConfig(background=text)


def test_the_mean_colour_is_of_training_pixels_that_count(tmp_path):
    """Masked pixels and held-out views have no part in it; where the preset does not ask for it the scene's colour stays."""
    scene = load_scene(scenes.write_colmap(tmp_path))
    first, second, *_ = scene.views
    mask = np.zeros((12, 16), bool)
    mask[:, :4] = True
    train = [dataclasses.replace(first, mask=mask), second]
    expected = np.concatenate([first.image[mask], second.image.reshape(-1, 3)]).astype(np.float64).mean(0)
    for wish in ("auto", "mean"):
        color, note = choose_background(wish, scene, train)
        np.testing.assert_allclose(color, expected, atol=1e-6)
        assert "the mean colour of the training views, #" in note
    assert choose_background("scene", scene, train) == ((0, 0, 0), "")
    assert choose_background("#ff0000", scene, train) == ((1, 0, 0), "background: #ff0000, #ff0000")
    assert [n for n, c in PRESETS.items() if c.background == "auto"] == ["default", "quick"]


def test_cut_out_objects_keep_the_background_of_the_scene(tmp_path):
    """Whether they know their opacity or stand on black."""
    scene = load_scene(scenes.write_blender(tmp_path))
    color, note = choose_background("auto", scene, list(scene.views))
    assert color == (1, 1, 1) and "#ffffff, since the views show a cut-out object" in note
    assert choose_background("scene", scene, list(scene.views))[1] == "background: #ffffff, from the scene's files"
    black = [dataclasses.replace(v, image=v.image * (v.alpha[..., None] > 0), alpha=None) for v in scene.views]
    assert choose_background("auto", dataclasses.replace(scene, background=(0, 0, 0)), black)[0] == (0, 0, 0)


def test_transparent_pixels_change_with_the_background_and_come_back(tmp_path):
    scene = load_scene(scenes.write_blender(tmp_path))
    half = [dataclasses.replace(v, alpha=v.alpha * np.float32(0.5), image=(v.image + 1) / 2) for v in scene.views]
    scene = dataclasses.replace(scene, views=tuple(half))
    other = over_background(scene, (0.0, 0.5, 1.0))
    assert other.background == (0, 0.5, 1) and other.views[0].image.dtype == np.float32
    np.testing.assert_allclose(other.views[0].image[0, 0], [0, 0.5, 1], atol=1e-6)
    np.testing.assert_allclose(other.views[0].image[0, 9], scene.views[0].image[0, 9] - [0.5, 0.25, 0], atol=1e-6)
    back = over_background(other, scene.background)
    assert all(np.allclose(a.image, b.image, atol=1e-6) for a, b in zip(back.views, scene.views))
    assert over_background(scene, scene.background) is scene


def test_a_run_keeps_its_background(tmp_path, capsys):
    """config.json holds the colour; scoring and continuing put the scene over it, and no colour makes another scene of it."""
    scenes.write_blender(tmp_path / "scene")
    flags = ["--init.source", "random", "--init.random-count", "20", "--preset", "3dgs", "--steps", "2", "--device", "cpu"]
    fit = [
        "fit",
        str(tmp_path / "scene"),
        "--out",
        str(tmp_path / "run"),
        "--split",
        "every:8",
        "--background",
        "0.5,0.25,0",
        *flags,
    ]
    assert main(fit) == 0
    assert "background: 0.5,0.25,0, #804000" in capsys.readouterr().out
    record = json.loads((tmp_path / "run" / "config.json").read_text())
    assert record["background"] == [0.5, 0.25, 0] and record["config"]["background"] == "0.5,0.25,0"
    assert record["fingerprint"] == load_scene(tmp_path / "scene").fingerprint
    stored = open_run(tmp_path / "run", "cpu")
    scene, _, test = scene_of(stored)
    assert stored.options().background.tolist() == [0.5, 0.25, 0] and scene.background == (0.5, 0.25, 0)
    np.testing.assert_allclose(test[0].image[0, 0], [0.5, 0.25, 0], atol=1e-6)
    assert main(["eval", str(tmp_path / "run"), "--device", "cpu"]) == 0
    scores = [json.loads((tmp_path / "run" / n).read_text())["test"]["psnr"] for n in ("metrics.json", "eval.json")]
    assert scores[0] == scores[1]
    assert main([*fit, "--resume"]) == 0
