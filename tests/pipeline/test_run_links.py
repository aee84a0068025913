"""Links in runs and results lead nowhere: not what is written, and not what is read; nor does a folder put in a run's place."""

import dataclasses
import os
import shutil

import pytest

import warpgs
from tests.pipeline.farms import HereEngine, jobs_of, write_scenes
from warpgs.app.cli import main
from warpgs.errors import ResourceError
from warpgs.pipeline.farm.farm import run_farm
from warpgs.pipeline.model.start import InitConfig
from warpgs.synthetic.demo import split_spec, write_demo

pytestmark = pytest.mark.skipif(os.name == "nt", reason="links need a right that users of Windows often lack")
CONFIG = warpgs.FitConfig(
    steps=6, checkpoint_every=2, checkpoint_seconds=0, init=InitConfig(source="random", random_count=50)
)  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A scene and a run on it."""
    folder = tmp_path_factory.mktemp("links")
    write_demo(folder / "scene", views=8, width=48, height=36)
    warpgs.fit(folder / "scene", CONFIG, split=split_spec(8), out=folder / "run", device="cpu", verbose=False)
    return folder


def contents(folder):
    """Every file with its bytes."""
    return {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def linked(run, name, outside):
    """Move a part of a run elsewhere, and link to it."""
    outside.mkdir(exist_ok=True)
    (run / name).rename(outside / name)
    (run / name).symlink_to(outside / name)
    return contents(outside)


@pytest.mark.parametrize("name", ["renders", "depth"])
def test_a_run_s_folder_that_is_a_link_is_refused_before_any_work(folder, tmp_path, capsys, name):
    """A second time under a link to the run itself, which is followed."""
    run, outside = tmp_path / "run", tmp_path / "outside"
    shutil.copytree(folder / "run", run)
    before = linked(run, name, outside)
    (tmp_path / "linked").symlink_to(run)
    for path in (run, tmp_path / "linked"):
        assert main(["eval", str(path), "--device", "cpu"]) == 4
        said = capsys.readouterr()
        assert f"{path / name}: is a link, and links inside of a results folder are not followed" in said.err
        assert "scoring" not in said.out and contents(outside) == before
    (run / name).unlink()
    assert main(["eval", str(tmp_path / "linked"), "--device", "cpu"]) == 0 and (run / name).is_dir()


@pytest.mark.parametrize("name", ["config.json", "checkpoint.safetensors"])
def test_a_run_s_file_that_is_a_link_is_not_read(folder, tmp_path, capsys, name):
    run = tmp_path / "run"
    shutil.copytree(folder / "run", run)
    linked(run, name, tmp_path / "outside")
    assert main(["export", str(run), "--to", str(tmp_path / "a.ply")]) == 3
    assert "is a link" in capsys.readouterr().err and not (tmp_path / "a.ply").exists()
    (run / name).unlink()
    os.mkfifo(run / name)
    assert main(["export", str(run), "--to", str(tmp_path / "a.ply")]) == 3


def test_a_render_below_a_run_is_not_led_out(folder, tmp_path, capsys):
    """The default folder of a path is below the run; one that the user names may be a link."""
    run, outside = tmp_path / "run", tmp_path / "outside"
    shutil.copytree(folder / "run", run)
    outside.mkdir()
    (run / "path-views").symlink_to(outside)
    words = ["render", str(run), "--path", "views", "--device", "cpu"]
    assert main(words) == 4 and "path-views: is a link" in capsys.readouterr().err and not list(outside.iterdir())
    assert main([*words, "--out", str(run / "path-views")]) == 0 and (outside / "film.mp4").is_file()


@pytest.mark.parametrize("name", ["log.txt", "run", "job.json", "thumbnail.jpg", "."])
def test_a_farm_s_job_writes_below_the_results_alone(tmp_path, name):
    """A log is appended to and a run set aside, so links are refused; records and images replace a link; the others go on."""
    scenes, results, outside = write_scenes(tmp_path / "scenes"), tmp_path / "results", tmp_path / "outside"
    outside.mkdir()
    (outside / "canary").write_bytes(b"the user's own")
    target = outside / "canary" if name.endswith((".txt", ".json", ".jpg")) else outside
    (results / "s0" / name).parent.mkdir(parents=True)
    if name == ".":
        (results / "s0").symlink_to(target)
    else:
        (results / "s0" / name).symlink_to(target)
    jobs = [dataclasses.replace(j, results=results) for j in jobs_of(scenes, results)]
    if name in ("log.txt", "."):
        with pytest.raises(ResourceError, match=f"{'s0' if name == '.' else name}: is a link"):
            _farm(jobs, results)
    else:
        first, second = _farm(jobs, results)
        assert second.state == "done" and first.state == ("failed" if name == "run" else "done")
        assert name != "run" or "run: is a link" in first.record.message
    assert contents(outside) == {(outside / "canary").relative_to(outside): b"the user's own"}
    assert [p.name for p in outside.iterdir()] == ["canary"] and outside.is_dir()


def _farm(jobs, results):
    from warpgs.files import writing_into

    with writing_into(results):
        return run_farm(jobs, HereEngine(), poll=0.01)


def test_a_run_folder_that_is_replaced_in_mid_fit_is_left_alone(folder, tmp_path):
    """The fit stops before its next write; what stands in its place keeps its own contents."""
    out = tmp_path / "run"

    def replace(report):
        if report.step == 3:
            out.rename(tmp_path / "moved")
            shutil.copytree(folder / "run", out)

    with pytest.raises(ResourceError, match="run: the folder was moved, removed or replaced while this command wrote into it"):
        warpgs.fit(
            folder / "scene", dataclasses.replace(CONFIG, seed=3), split=split_spec(8), out=out, device="cpu", verbose=False,
            on_step=replace,
        )  # fmt: skip
    assert contents(out) == contents(folder / "run")
    assert (tmp_path / "moved" / "checkpoint.safetensors").is_file()
