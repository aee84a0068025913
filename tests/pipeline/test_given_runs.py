"""`warpgs fit --depths --normals`: what it says, what a run keeps of it, and what continues it or scores it."""

import html
import json

import numpy as np
import pytest

import warpgs
from tests.io.scenes import save
from tests.priors.rigs import exact_depth
from warpgs.app.cli import main
from warpgs.pipeline.run.request import SceneRequest
from warpgs.synthetic import demo

VIEWS, SIZE, STEPS = 8, (48, 36), 8
SPLIT = demo.split_spec(VIEWS)


def write_depths(folder, factor=1.0):
    """Write the true depth of the demo's views, but of the first, in millimetres as 16-bit PNG."""
    for i, camera in enumerate(demo.camera_path(VIEWS, *SIZE)):
        if i:
            save(folder / f"{i:03d}.png", np.round(1000 * factor * exact_depth(demo.still_life(0), camera)).astype(np.uint16))
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A scene, its maps and a run with them."""
    folder = tmp_path_factory.mktemp("given")
    demo.write_demo(folder / "scene", views=VIEWS, width=SIZE[0], height=SIZE[1])
    write_depths(folder / "depths")
    assert main(command(folder, folder / "run", "--depths", str(folder / "depths"))) == 0
    return folder


def command(folder, out, *more, steps=STEPS):
    flags = ["--device", "cpu", "--split", SPLIT, "--preset", "3dgs", "--steps", str(steps), "--sh-degree", "0"]
    return ["fit", str(folder / "scene"), "--out", str(out), *flags, *more]


def test_a_run_says_and_keeps_what_was_given(folder, capsys):
    """Notes before the first step and after the last, figures of each view, and the settings by which the scene is read."""
    record, metrics = (json.loads((folder / "run" / f).read_text()) for f in ("config.json", "metrics.json"))
    notes = html.unescape((folder / "run" / "report.html").read_text())
    assert (
        "depth maps: 7 of 8 views, 100.0% of their pixels, metric (a unit is 0.001 for integers" in notes
        and "given depth: used in 5 of 6 views" in notes
    )
    assert "median difference of rendered depth" in notes and "start: " in notes and "by given depth and sweep" in notes
    assert record["scene"]["depths"] == str(folder / "depths") and record["scene"]["depth_kind"] == "metric"
    rows = metrics["given"]["depth"]["views"]
    assert len(rows) == 5 and all(r["coverage"] > 0.9 and 0 < r["difference"] < 0.5 for r in rows)
    assert main(["eval", str(folder / "run"), "--device", "cpu"]) == 0


def test_maps_decide_whether_a_run_continues(folder, tmp_path, capsys):
    """The same maps give the same bits as an uninterrupted run; other maps are another scene."""
    run = tmp_path / "run"
    maps = ["--depths", str(folder / "depths")]

    def stop(report):
        if report.step == 5:
            raise KeyboardInterrupt

    request = SceneRequest(str(folder / "scene"), SPLIT, depths=str(folder / "depths"))
    config = {"preset": "3dgs", "steps": STEPS, "sh_degree": 0, "device": "cpu", "verbose": False}
    with pytest.raises(KeyboardInterrupt):
        warpgs.fit(request, out=run, on_step=stop, **config)
    assert main(["fit", "--out", str(run), "--resume"]) == 0
    whole, again = (warpgs.open_run(f, "cpu").gaussians().tensors() for f in (folder / "run", run))
    assert all((whole[n] == again[n]).all() for n in whole)
    other = write_depths(tmp_path / "other", 1.01)
    assert main(command(folder, run, "--depths", str(other), "--resume")) == 2
    assert "the scene" in capsys.readouterr().err
    assert main(command(folder, run, *maps, "--resume")) == 0
    assert f"all {STEPS} steps are taken; only the images, scores and report are made again" in capsys.readouterr().out


def test_a_wrong_unit_is_named_before_the_first_step(folder, tmp_path, capsys):
    """With the ratio, view by view, and the flag that mends it; it mends it."""
    out = tmp_path / "run"
    assert main(command(folder, out, "--depths", str(folder / "depths"), "--depth-unit", "1")) == 3
    said = capsys.readouterr().err
    assert "no depth map can be used" in said and "times those that the views confirm" in said and "--depth-unit" in said
    assert not (out / "metrics.jsonl").exists()
    assert main(command(folder, out, "--depths", "nowhere")) == 3 and "no such folder" in capsys.readouterr().err


def test_scenes_from_python(folder):
    """`load_scene(depths=...)` and fit; a weight of 0 leaves the loss out."""
    scene = warpgs.load_scene(folder / "scene", depths=folder / "depths")
    fitted = warpgs.fit(scene, "3dgs", split=SPLIT, steps=2, device="cpu", verbose=False, loss_depth_weight=0.0)
    assert fitted.metrics["given"] == {} and any("given depth: used in 5" in n for n in fitted.notes)
