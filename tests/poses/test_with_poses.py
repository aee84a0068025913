"""A fit of photographs without cameras: poses are found once, kept in the run folder, and found there again."""

import shutil
from types import SimpleNamespace

import pytest

from warpgs.errors import UsageError
from warpgs.files import write_json
from warpgs.pipeline.run import fit as module
from warpgs.pipeline.run.fit import fit, lost_lines, with_poses
from warpgs.pipeline.run.folder import StoredRun, run_folder
from warpgs.pipeline.run.request import SceneRequest
from warpgs.poses.find import JSON


def test_poses_are_kept_in_the_run_folder(tmp_path, photographs, found, monkeypatch):
    """Found at first; a continued run takes them from there, and refuses other photographs."""
    calls, said, run = [], [], tmp_path / "run"
    run.mkdir()

    def copied(source, out, **options):
        calls.append(source)
        assert options["matcher"] == "x.onnx"
        shutil.copytree(found[0], out)
        return found[1]

    monkeypatch.setattr(module, "find_poses", copied)
    shutil.copytree(photographs, tmp_path / "in")
    request = SceneRequest(str(tmp_path / "in"), matcher="x.onnx")
    for _ in range(2):
        posed, notes = with_poses(request, run, said.append)
        assert (
            posed.path == str(run / "scene")
            and posed.matcher is None
            and any(n.startswith("poses found for 6 of 6") for n in notes)
        )
    assert calls == [tmp_path / "in"] and "has no cameras: finding the poses" in said[0]
    (tmp_path / "in" / "0.png").write_bytes((tmp_path / "in" / "1.png").read_bytes())
    with pytest.raises(UsageError, match="holds poses of other photographs than"):
        with_poses(request, run, said.append)
    for resume in (False, True):  # a fit that ended before its first step begins again either way
        with run_folder(run, resume):
            pass


def test_photographs_without_a_pose_are_told_of_at_the_end(tmp_path, found):
    scene = tmp_path / "scene"
    scene.mkdir()
    rows = found[1]["photographs"]
    missing = f"2 of 6 photographs have no pose and were not used: {scene / 'poses.txt'} lists reasons and remedies"
    for lost, said in ((0, []), (2, [missing])):
        unposed = [p | {"registered": False, "reason": "has none"} for p in rows[:lost]]
        write_json(scene / JSON, found[1] | {"photographs": [*unposed, *rows[lost:]]})
        assert [line.partition(", and")[0] for line in lost_lines(tmp_path)] == said
    assert lost_lines(None) == lost_lines(scene) == []


def test_other_requests_stay_as_they_are(tmp_path, photographs, found):
    for request in (SceneRequest(str(found[0])), SceneRequest(str(photographs), reader="llff"), SceneRequest("")):
        assert with_poses(request, tmp_path, print) == (request, [])
    with pytest.raises(UsageError, match=r"--matcher requires a folder of photographs without cameras; leave it out for"):
        with_poses(SceneRequest(str(found[0]), matcher="x.onnx"), tmp_path, print)
    with pytest.raises(UsageError, match="needs a run folder; give out="):
        with_poses(SceneRequest(str(photographs)), None, print)


def test_a_split_that_is_not_understood_is_refused_before_poses_are_found(tmp_path, photographs, monkeypatch):
    monkeypatch.setattr(module, "find_poses", lambda *_, **__: pytest.fail("poses are found"))
    for spec in ("every8", "every:1", "tset=0.png"):
        with pytest.raises(UsageError, match="split"):
            fit(SceneRequest(str(photographs), spec), out=tmp_path / "run", device="cpu", verbose=False)
    assert not (tmp_path / "run").exists()


def test_a_run_that_was_moved_finds_its_scene(tmp_path, found):
    """The record holds where the scene lay; where nothing is there any more, the run's own scene is read."""
    options = {"path": str(tmp_path / "gone" / "scene"), "downscale": 2}
    run = SimpleNamespace(folder=tmp_path, record={"scene": options})
    assert StoredRun.scene_request(run).path == options["path"]
    (tmp_path / "scene").mkdir()
    shutil.copy(found[0] / "poses.json", tmp_path / "scene")
    assert StoredRun.scene_request(run) == SceneRequest(str(tmp_path / "scene"), downscale=2)
