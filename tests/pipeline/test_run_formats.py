"""Run folders of another version: one clear sentence from every command, and no traceback."""

import json
import shutil

import pytest

from warpgs.app.cli import main
from warpgs.errors import DataError
from warpgs.pipeline.run.folder import FORMAT, TENSORS, load_checkpoint, open_run
from warpgs.synthetic.demo import write_demo

OLD_CONFIG = {
    "scene": {
        "path": "/scene", "split": None, "downscale": 1, "strict": False, "allow_outside": False, "invert_masks": False,
        "score_masks": None,
    },
    "format": "colmap", "fingerprint": "0" * 64, "train": ["000.png"], "test": [], "notes": [],
    "normalization": {"offset": [0.0, 0.0, 0.0], "scale": 1.0}, "background": [0.0, 0.0, 0.0],
    "config": {"preset": "quick", "steps": 600, "half": 0.0, "rule": "exact"}, "config_hash": "3be867cbcc33", "device": "cpu",
    "versions": {"warpgs": "0.1.0", "python": "3.11.9"},
    "cameras": {"000.png": {"viewmat": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
                            "K": [[1, 0, 1], [0, 1, 1], [0, 0, 1]], "width": 2, "height": 2}},
}  # fmt: skip
"""config.json as version 0.1.0 wrote it, shortened."""


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A scene and a short run on it."""
    folder = tmp_path_factory.mktemp("formats")
    write_demo(folder / "scene", views=8, width=32, height=32)
    flags = ["--steps", "4", "--device", "cpu", "--init.source", "random", "--init.random-count", "50", "--preset", "3dgs"]
    assert main(["fit", str(folder / "scene"), "--out", str(folder / "run"), *flags]) == 0
    return folder / "run", ["fit", str(folder / "scene"), *flags]


@pytest.mark.parametrize("command", ["resume", "eval", "render", "export", "prune"])
def test_runs_of_version_0_1_0_are_refused_by_name(run, tmp_path, capsys, command):
    """The sentence names the file, both versions and the way out; nothing is written."""
    old = tmp_path / "old"
    old.mkdir()
    (old / "config.json").write_text(json.dumps(OLD_CONFIG))
    arguments = {
        "resume": [*run[1], "--out", str(old), "--resume"],
        "export": ["export", str(old), "--to", f"{tmp_path}/a.ply"],
    }
    assert main(arguments.get(command, [command, str(old)])) == 3
    error = capsys.readouterr().err
    assert "config.json: warpgs 0.1.0 wrote this run" in error and "warpgs 0.2.0 does not read" in error
    assert "fit the scene again into a new --out" in error and "Traceback" not in error
    assert [p.name for p in old.iterdir()] == ["config.json"] and not (tmp_path / "a.ply").exists()


def test_the_format_is_a_number_in_both_files(run, tmp_path):
    """config.json and the header of the checkpoint carry it; a checkpoint of another one is refused by its version."""
    import hashlib

    record = json.loads((run[0] / "config.json").read_text())
    assert record["format"] == FORMAT == 2 and record["scene_format"] == "colmap"
    assert open_run(run[0], "cpu").step == 4
    copy = tmp_path / "run"
    shutil.copytree(run[0], copy)
    body = (
        (copy / TENSORS).read_bytes()[:-32].replace(b'"format": "2", "version": "0.2.0"', b'"format": "9", "version": "7.0.0"')
    )
    (copy / TENSORS).write_bytes(body + hashlib.sha256(body).digest())
    with pytest.raises(DataError, match=r"warpgs 7\.0\.0 wrote this checkpoint, in a format that warpgs 0\.2\.0 does not read"):
        load_checkpoint(copy)
    with pytest.raises(DataError, match="not a record of a fit"):
        (copy / "config.json").write_text("[1]")
        open_run(copy)
