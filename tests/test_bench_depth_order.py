"""The order of depths: exact where the rendering is, reversed where it is mirrored, measured on a real run of the demo."""

import json
import re

import numpy as np
import pytest

from bench.experiments.depth_order import depth_order, main
from warpgs.app.cli import main as warpgs
from warpgs.io.load import load_scene
from warpgs.scene import Camera
from warpgs.synthetic import raycast
from warpgs.synthetic.demo import split_spec, still_life, write_demo


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A small demo scene, whose points are exact."""
    folder = tmp_path_factory.mktemp("data") / "scene"
    write_demo(folder, views=9, width=96, height=72)
    return folder


def true_depth(camera: Camera, offset: np.ndarray, scale: float) -> np.ndarray:
    """z-depth [file units] that rays through the pixel centres of a scene camera meet in the demo, [H, W]."""
    viewmat = camera.viewmat.copy()
    viewmat[:3, 3] = camera.viewmat[:3, 3] / scale - camera.viewmat[:3, :3] @ offset
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = raycast.pixel_rays(camera.K, viewmat, np.stack([x.ravel(), y.ravel()], 1))
    distance, _ = raycast.cast(still_life(), -viewmat[:3, :3].T @ viewmat[:3, 3], rays)
    return (distance * (rays @ viewmat[2, :3])).reshape(y.shape)


def test_true_depth_is_in_order_and_its_inverse_is_not(scene):
    """1 up to pixels on edges for what the rays meet, at another size and in other units too; -1 for the inverse depth."""
    loaded = load_scene(str(scene))
    view = loaded.views[4]
    depth = true_depth(view.camera, loaded.normalization.offset, loaded.normalization.scale)
    seen, full = loaded.points.seen_by({view.name}), np.ones_like(depth)
    order = depth_order(view.name, depth, full, view.camera, seen)
    assert order.correlation > 0.995 and order.drawn == order.points == len(seen) > 100
    assert depth_order("", 1 / depth, full, view.camera, seen).correlation == pytest.approx(-order.correlation, abs=1e-3)
    twice = 7 * depth.repeat(2, 0).repeat(2, 1)
    assert depth_order("", twice, np.ones_like(twice), view.camera, seen).correlation == pytest.approx(order.correlation)
    shuffled = np.random.default_rng(0).permutation(depth.ravel()).reshape(depth.shape)
    assert abs(depth_order("", shuffled, full, view.camera, seen).correlation) < 0.2


def test_points_on_nothing_do_not_count(scene):
    """Only covered pixels are compared; of too few, or of a flat depth, nothing is said."""
    loaded = load_scene(str(scene))
    view = loaded.views[4]
    seen = loaded.points.seen_by({view.name})
    depth = true_depth(view.camera, loaded.normalization.offset, loaded.normalization.scale)
    left = (np.arange(96) < 48) * np.ones((72, 1))
    half = depth_order("", depth, left, view.camera, seen)
    assert 0.2 < half.drawn / half.points < 0.8 and half.correlation > 0.99
    nothing = depth_order("", depth, np.zeros_like(depth), view.camera, seen)
    assert nothing.drawn == 0 and np.isnan(nothing.correlation)
    assert np.isnan(depth_order("", np.ones_like(depth), np.ones_like(depth), view.camera, seen).correlation)


def test_a_run_is_measured(scene, tmp_path, capsys):
    """A short fit from the exact points has its held-out depths nearly in order, a line per view; mistakes are told."""
    run = tmp_path / "run"
    flags = ["--preset", "3dgs", "--steps", "30", "--init.source", "points", "--device", "cpu", "--out", str(run)]
    assert warpgs(["fit", str(scene), "--split", split_spec(9), *flags]) == 0
    capsys.readouterr()
    assert main([str(run), str(scene)]) == 0
    *lines, mean = capsys.readouterr().out.splitlines()
    held_out = json.loads((run / "config.json").read_text())["test"]
    assert [line.split(":")[0] for line in lines] == held_out and mean.startswith("mean of 3 views")
    values = [float(re.search(r"correlation (\S+) over", line)[1]) for line in lines]
    assert min(values) > 0.8 and float(mean.split()[-1]) == pytest.approx(np.mean(values), abs=1e-4)
    tracks = load_scene(str(scene)).points.tracks
    assert [int(line.split()[-2]) for line in lines] == [sum(name in t for t in tracks) for name in held_out]
    record = json.loads((run / "config.json").read_text())
    (run / "config.json").write_text(json.dumps(record | {"test": []}))
    assert main([str(run), str(scene)]) == 3 and "holds no view out" in capsys.readouterr().err
    record["cameras"]["other.png"] = record["cameras"][held_out[0]]
    (run / "config.json").write_text(json.dumps(record | {"test": ["other.png"]}))
    assert main([str(run), str(scene)]) == 3 and "lacks other.png" in capsys.readouterr().err
