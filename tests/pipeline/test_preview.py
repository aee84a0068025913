"""`warpgs priors show` as a user types it."""

import cv2
import numpy as np
import pytest

from tests.priors import networks as nw
from warpgs.app.cli import main
from warpgs.synthetic.demo import split_spec, write_demo


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A small demo scene."""
    folder = tmp_path_factory.mktemp("data") / "scene"
    write_demo(folder, views=9, width=64, height=48)
    return folder


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    """Nothing goes to the user's cache."""
    monkeypatch.setenv("WARPGS_CACHE", str(tmp_path / "cache"))


def show(scene, *flags):
    return ["priors", "show", str(scene), "--split", split_spec(9), *map(str, flags)]


def test_a_sheet_per_training_view(scene, tmp_path, capsys):
    """With networks: sheets, notes, and maps that are there the second time."""
    depth = nw.depth_network(tmp_path / "d.onnx")
    labels = nw.segmentation_network(tmp_path / "s.onnx")
    (tmp_path / "d.onnx.json").write_text('{"size": 64}')
    (tmp_path / "s.onnx.json").write_text('{"size": 64, "mean": [0, 0, 0], "std": [1, 1, 1]}')
    flags = ["--depth-model", depth, "--segmentation-model", labels, "--threads", 1]
    assert main(show(scene, "--out", tmp_path / "a", *flags)) == 0
    text = capsys.readouterr().out
    sheets = sorted((tmp_path / "a").glob("*.png"))
    assert f"{len(sheets)} sheets in {tmp_path / 'a'}" in text and len(sheets) >= 3
    assert "d.onnx (SHA-256 " in text and "assumed multiple 32, mean 0.5 0.5 0.5" in text
    sheet = cv2.imread(str(sheets[0]))
    assert sheet.shape[1] > 1500 and sheet.std() > 20
    assert main(show(scene, "--out", tmp_path / "b", *flags)) == 0
    assert f"{2 * len(sheets)} of {2 * len(sheets)} maps were read from the cache" in capsys.readouterr().out
    for path in sheets:
        np.testing.assert_array_equal(cv2.imread(str(tmp_path / "b" / path.name)), cv2.imread(str(path)))


@pytest.mark.parametrize("source", ["sweep", "flow"])
def test_without_networks_the_notes_say_what_stands_in(scene, tmp_path, capsys, source):
    """Depth comes from the other views, and some of it is confirmed in every one."""
    assert main(show(scene, "--out", tmp_path / "a", "--source", source)) == 0
    text = capsys.readouterr().out
    assert "semantics: no network, so saliency is used as foreground" in text and "held out" not in text
    assert "depth: from the other views, " in text and "no consistent depth" not in text
    assert not (tmp_path / "cache").exists()


def failure(capsys, code, *arguments):
    """Run a command that must fail with that code and one line on stderr; returns the line."""
    assert main(list(arguments)) == code
    text = capsys.readouterr().err.strip()
    assert text.startswith("warpgs: ") and "internal error" not in text and len(text.splitlines()) == 1
    return text


def test_mistakes_get_one_line(scene, tmp_path, capsys):
    """2 usage, 3 data, 4 resources."""
    out = tmp_path / "out"
    assert "give show or export" in failure(capsys, 2, "priors")
    assert "give show or export" in failure(capsys, 2, "priors", "draw")
    assert "source 'lidar' is not one of sweep, flow" in failure(capsys, 2, *show(scene, "--out", out, "--source", "lidar"))
    assert "--threads must be a number from 0" in failure(capsys, 2, *show(scene, "--out", out, "--threads", -1))
    assert "depth-size was removed: give it in FILE.onnx.json" in failure(
        capsys, 2, *show(scene, "--out", out, "--depth-size", 64)
    )
    (tmp_path / "x.onnx").write_text("no network")
    assert "not an ONNX model" in failure(capsys, 3, *show(scene, "--out", out, "--depth-model", tmp_path / "x.onnx"))
    assert "cannot be read" in failure(capsys, 3, *show(scene, "--out", out, "--segmentation-model", tmp_path / "none.onnx"))
    below = scene / "images" / "000.png" / "sheets"
    assert "choose another folder" in failure(capsys, 4, *show(scene, "--out", below))
    assert not out.exists() or not list(out.iterdir())
    assert main(["priors", "--help"]) == 0 and "priors export" in capsys.readouterr().out
