"""Run folders: one fit each, other versions, links that lead nowhere, names of images."""

import dataclasses
import hashlib
import json
import os
import shutil
import unicodedata

import pytest
import torch
from hypothesis import given, strategies as st

import warpgs
from tests.pipeline.farms import HereEngine, jobs_of, write_scenes
from tests.scenes import photos, seeds
from warpgs.app.cli import main
from warpgs.errors import DataError, FolderHeldError, ResourceError, UsageError
from warpgs.files import LOCK, writing_into
from warpgs.locks import hold_folder
from warpgs.pipeline.farm.farm import run_farm
from warpgs.pipeline.films.film import FilmSettings
from warpgs.pipeline.metrics.scores import Renders
from warpgs.pipeline.model.start import InitConfig, initial_gaussians
from warpgs.pipeline.run import fit as fit_module
from warpgs.pipeline.run.commands import evaluate, render
from warpgs.pipeline.run.export import export
from warpgs.pipeline.run.folder import FORMAT, TENSORS, load_checkpoint, open_run
from warpgs.pipeline.run.results import evaluate_run
from warpgs.render.options import RasterizeOptions
from warpgs.report.page import image_names, renaming_notes
from warpgs.synthetic.demo import write_demo

# A run folder belongs to one fit at a time, and to one fit for good.

CONFIG = warpgs.FitConfig(steps=2, init=InitConfig(source="random", random_count=50))
LEFT = ".warpgs-0123456789abcdef.tmp"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("folders")
    write_demo(folder / "scene", views=8, width=32, height=32)
    warpgs.fit(folder / "scene", CONFIG, out=folder / "run", device="cpu", verbose=False)
    return folder


def fit(folder, out, config=CONFIG, **options):
    return warpgs.fit(folder / "scene", config, out=out, device="cpu", verbose=False, **options)


def contents(folder):
    return {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_a_second_fit_into_a_folder_is_refused(folder, tmp_path, monkeypatch):
    choose, refused = fit_module.choose_device, []

    def choose_device(name):
        if not refused:
            refused.append(None)
            with pytest.raises(ResourceError, match=f"process {os.getpid()} on .* is writing there"):
                fit(folder, tmp_path / "run", dataclasses.replace(CONFIG, seed=5))
            refused.append("said")
        return choose(name)

    monkeypatch.setattr(fit_module, "choose_device", choose_device)
    assert fit(folder, tmp_path / "run").config.seed == 0 and refused == [None, "said"]
    assert json.loads((tmp_path / "run" / "config.json").read_text())["config"]["seed"] == 0
    assert not (tmp_path / "run" / LOCK).exists()


def test_whatever_writes_into_a_run_waits_for_nobody(folder, tmp_path, capsys):
    """While a folder is held, resuming, scoring, rendering and comparing there end with one line; reading goes on."""
    run, scene, cpu = tmp_path / "run", str(folder / "scene"), ["--device", "cpu"]
    shutil.copytree(folder / "run", run)
    before = contents(run)
    with hold_folder(run), hold_folder(run / "path-views"), hold_folder(tmp_path / "priors"):
        for resume in (True, False):
            with pytest.raises(FolderHeldError, match=f"process {os.getpid()} on .* is writing there"):
                fit(folder, run, resume=resume)
        for words in (
            ["eval", str(run), *cpu],
            ["render", str(run), "--path", "views", *cpu],
            ["export", str(run), "--to", str(run / "a.ply")],
            ["prune", str(run), "--keep-psnr", "3", "--out", str(run / "pruned"), *cpu],
            ["compare", scene, "--out", str(run), "--presets", "3dgs,mcmc", "--steps", "1", "--split", "every:4", *cpu],
            ["priors", "show", scene, "--out", str(tmp_path / "priors"), "--split", "every:4"],
        ):
            assert main(words) == 4, words
            assert "is writing there" in capsys.readouterr().err
        assert main(["export", str(run), "--to", str(tmp_path / "a.ply")]) == 0
        assert warpgs.open_run(run, "cpu").step == 2
    shutil.rmtree(run / "path-views", ignore_errors=True)
    assert contents(run) == before
    (run / LOCK).write_text("")  # which nobody holds
    with pytest.raises(UsageError, match="exists already; choose another --out, or continue that run with --resume"):
        fit(folder, run)


@pytest.mark.parametrize("key", ["config", "fingerprint"])
def test_a_checkpoint_of_another_fit_is_not_continued(folder, tmp_path, key):
    """It was copied from a run with another seed, or on other data: nothing of either run is lost."""
    other = folder / "other"
    if not other.exists():
        write_demo(other / "scene", views=8, width=32, height=32, seed=1)
    config = dataclasses.replace(CONFIG, seed=9) if key == "config" else CONFIG
    fit(folder if key == "config" else other, tmp_path / "foreign", config)
    shutil.copytree(folder / "run", tmp_path / "run")
    shutil.copy(tmp_path / "foreign" / TENSORS, tmp_path / "run" / TENSORS)
    before = contents(tmp_path / "run")
    with pytest.raises(DataError, match=f"{key} differs between .*safetensors and config.json"):
        fit(folder, tmp_path / "run", resume=True)
    assert contents(tmp_path / "run") == before


def test_what_killed_commands_left_is_removed_and_a_fit_that_has_not_ended_is_named(folder, tmp_path):
    """Files and folders under temporary names; the user's own stay; none is named for a finished run."""
    run, cpu = str(folder / "run"), ["--device", "cpu"]
    for words in (["export", run, "--to", str(tmp_path / "a.ply")], ["prune", run, "--out", str(tmp_path / "b"), *cpu]):
        (tmp_path / LEFT).mkdir()
        (tmp_path / LEFT / "config.json").touch()
        (tmp_path / LEFT.replace("0", "1")).touch()
        (tmp_path / "own.tmp").touch()
        assert main(words) == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.ply", "b", "own.tmp"]
    run = shutil.copytree(folder / "run", tmp_path / "run")
    commands = [
        lambda: export(run, tmp_path / "a.ply"), lambda: evaluate(run, "cpu"),
        lambda: render(run, "views", tmp_path / "film", FilmSettings(), "cpu"),
    ]  # fmt: skip
    assert not [line for c in commands for line in c() if "the fit stopped" in line]
    (run / "metrics.json").unlink()
    for command in commands:
        (line,) = [line for line in command() if "the fit stopped after step 2" in line]
        assert "--resume" in line


def test_folders_of_errors_and_of_killed_fits(folder, tmp_path):
    (tmp_path / "own").mkdir()
    for out in ("own", "made"):
        with pytest.raises(DataError, match="no such folder"):
            warpgs.fit(tmp_path / "nowhere", CONFIG, out=tmp_path / out, device="cpu")
    assert [p.name for p in tmp_path.iterdir()] == ["own"]
    # a lock file and half of config.json are as good as empty
    out = tmp_path / "run"
    out.mkdir()
    (out / LOCK).write_text("")
    (out / LEFT).write_text('{"format": 2,')
    with pytest.raises(UsageError, match=r"holds no config\.json; give the folder"):
        fit(folder, out, resume=True)
    assert fit(folder, out).step == 2
    assert not (out / LEFT).exists() and not (out / LOCK).exists()
    (tmp_path / "users").mkdir()
    (tmp_path / "users" / "a.tmp.123.456").write_text("not ours")
    with pytest.raises(UsageError, match="exists already"):
        fit(folder, tmp_path / "users")


@pytest.mark.skipif(os.name == "nt", reason="Windows has other limits and rights")
def test_a_folder_that_cannot_be_made_or_read_is_the_users_matter(folder, tmp_path, capsys):
    words = ["fit", str(folder / "scene"), "--device", "cpu", "--out"]
    for more in ([], ["--resume"]):
        assert main([*words, str(tmp_path / ("x" * 300)), *more]) in (2, 4)
        assert ("internal error" not in (said := capsys.readouterr().err) and "choose another" in said) or more
    if os.geteuid():
        (tmp_path / "shut").mkdir(mode=0)
        assert main([*words, str(tmp_path / "shut")]) == 4
        assert "may read and write" in capsys.readouterr().err


# Run folders of another version: one clear sentence from every command, and no traceback.


@pytest.mark.parametrize("command", ["resume", "eval", "render", "export", "prune"])
def test_runs_of_version_0_1_0_are_refused_by_name(folder, tmp_path, capsys, command):
    old = tmp_path / "old"
    old.mkdir()
    record = {"format": "colmap", "config": {"preset": "quick", "steps": 600, "half": 0.0}, "versions": {"warpgs": "0.1.0"}}
    (old / "config.json").write_text(json.dumps(record))
    arguments = {
        "resume": ["fit", str(folder / "scene"), "--preset", "3dgs", "--device", "cpu", "--out", str(old), "--resume"],
        "export": ["export", str(old), "--to", f"{tmp_path}/a.ply"],
    }
    assert main(arguments.get(command, [command, str(old)])) == 3
    error = capsys.readouterr().err
    assert "config.json: warpgs 0.1.0 wrote this run" in error and "warpgs 0.2.0 does not read" in error
    assert "fit the scene again into a new --out" in error and "Traceback" not in error
    assert [p.name for p in old.iterdir()] == ["config.json"] and not (tmp_path / "a.ply").exists()


def test_the_format_is_a_number_in_both_files(folder, tmp_path):
    copy = shutil.copytree(folder / "run", tmp_path / "run")
    record = json.loads((copy / "config.json").read_text())
    assert record["format"] == FORMAT == 2 and record["scene_format"] == "colmap" and open_run(copy, "cpu").step == 2
    body, ours, other = (
        (copy / TENSORS).read_bytes()[:-32],
        b'"format": "2", "version": "0.2.0"',
        b'"format": "9", "version": "7.0.0"',
    )
    body = body.replace(ours, other)
    (copy / TENSORS).write_bytes(body + hashlib.sha256(body).digest())
    with pytest.raises(DataError, match=r"warpgs 7\.0\.0 wrote this checkpoint, in a format that warpgs 0\.2\.0 does not read"):
        load_checkpoint(copy)


# Links in runs and results are not followed, neither for writing nor for reading, nor is a folder put in a run's place.

with_links = pytest.mark.skipif(os.name == "nt", reason="links need a right that users of Windows often lack")


def linked(run, name, outside):
    outside.mkdir(exist_ok=True)
    (run / name).rename(outside / name)
    (run / name).symlink_to(outside / name)
    return contents(outside)


@with_links
@pytest.mark.parametrize("name", ["renders", "depth"])
def test_a_run_s_folder_that_is_a_link_is_refused_before_any_work(folder, tmp_path, capsys, name):
    """A second time under a link to the run itself, which is followed."""
    run, outside = shutil.copytree(folder / "run", tmp_path / "run"), tmp_path / "outside"
    before = linked(run, name, outside)
    (tmp_path / "linked").symlink_to(run)
    for path in (run, tmp_path / "linked"):
        assert main(["eval", str(path), "--device", "cpu"]) == 4
        said = capsys.readouterr()
        assert f"{path / name}: is a link inside of a results folder" in said.err
        assert "scoring" not in said.out and contents(outside) == before
    (run / name).unlink()
    assert main(["eval", str(tmp_path / "linked"), "--device", "cpu"]) == 0 and (run / name).is_dir()


@with_links
@pytest.mark.parametrize("name", ["config.json", "checkpoint.safetensors"])
def test_a_run_s_file_that_is_a_link_is_not_read(folder, tmp_path, capsys, name):
    run = shutil.copytree(folder / "run", tmp_path / "run")
    linked(run, name, tmp_path / "outside")
    assert main(["export", str(run), "--to", str(tmp_path / "a.ply")]) == 3
    assert "is a link" in capsys.readouterr().err and not (tmp_path / "a.ply").exists()
    (run / name).unlink()
    os.mkfifo(run / name)
    assert main(["export", str(run), "--to", str(tmp_path / "a.ply")]) == 3


@with_links
def test_a_render_below_a_run_is_not_led_out(folder, tmp_path, capsys):
    """The default folder of a path is below the run; one that the user names may be a link."""
    run, outside = shutil.copytree(folder / "run", tmp_path / "run"), tmp_path / "outside"
    outside.mkdir()
    (run / "path-views").symlink_to(outside)
    words = ["render", str(run), "--path", "views", "--device", "cpu"]
    assert main(words) == 4 and "path-views: is a link" in capsys.readouterr().err and not list(outside.iterdir())
    assert main([*words, "--out", str(run / "path-views")]) == 0 and (outside / "film.mp4").is_file()


@with_links
@pytest.mark.parametrize("name", ["log.txt", "run", "job.json", "."])
def test_a_farm_s_job_writes_below_the_results_alone(tmp_path, name):
    """A log is appended to and a run set aside, so links are refused; records replace a link; the others go on."""
    scenes, results, outside = write_scenes(tmp_path / "scenes"), tmp_path / "results", tmp_path / "outside"
    outside.mkdir()
    (outside / "canary").write_bytes(b"the user's own")
    link = results / "s0" if name == "." else results / "s0" / name
    link.parent.mkdir(parents=True)
    link.symlink_to(outside / "canary" if "." in name[1:] else outside)
    with writing_into(results):
        if name in ("log.txt", "."):
            with pytest.raises(ResourceError, match=f"{link.name}: is a link"):
                run_farm(jobs_of(scenes, results), HereEngine(), poll=0.01)
        else:
            first, second = run_farm(jobs_of(scenes, results), HereEngine(), poll=0.01)
            assert second.state == "done" and first.state == ("failed" if name == "run" else "done")
            assert name != "run" or "run: is a link" in first.record.message
    assert [*contents(outside).values()] == [b"the user's own"] and [p.name for p in outside.iterdir()] == ["canary"]


@with_links
def test_a_run_folder_that_is_replaced_in_mid_fit_is_left_alone(folder, tmp_path):
    out, config = tmp_path / "run", dataclasses.replace(CONFIG, steps=6, checkpoint_every=2, seed=3)

    def replace(report):
        if report.step == 3:
            out.rename(tmp_path / "moved")
            shutil.copytree(folder / "run", out)

    with pytest.raises(ResourceError, match="run: the folder was moved, removed or replaced meanwhile"):
        fit(folder, out, config, on_step=replace)
    assert contents(out) == contents(folder / "run") and (tmp_path / "moved" / "checkpoint.safetensors").is_file()


# Each view has image files of its own, whatever the views are called and whichever system they lie on.


def test_plain_names_stay_as_they_are():
    names = image_names(["000.png", "left/IMG_1.JPG", "a.b.png", "Größe 1.png"])
    assert list(names.values()) == ["000", "left_IMG_1", "a.b", "Größe 1"] and renaming_notes(names) == []


@pytest.mark.parametrize(
    "views",
    [["a/b.png", "a_b.png"], ["c.png", "C.png"], ["c.png", "c.jpg"], ["é.png", "e\u0301.png"], ["Straße.png", "STRASSE.png"],
     ["x" * 251 + ".png", "x" * 250 + "y.png"], ["con.png", "NUL"], ["a?b.png", "a*b.png"],
     [".warpgs.lock", "..", "/", ".png"]],
    ids=["folder", "capitals", "suffix", "accent", "ss", "long", "reserved", "signs", "hidden"],
)  # fmt: skip
def test_names_that_meet_are_told_apart(views):
    """In no case two files that some system takes for one; the order of the views does not matter; the note names them."""
    names = image_names(views)
    folded = {unicodedata.normalize("NFC", n.casefold()) for n in names.values()}
    assert len(folded) == len(views) and all(len(n.encode()) <= 100 and not n.startswith(".") for n in names.values())
    assert not any(set(n) & set('<>:"\\|?*/') for n in names.values())
    assert image_names(views[:2][::-1] + views[2:]) == names
    (note,) = renaming_notes(names)
    assert f"{views[0]} is {names[views[0]]}.png" in note


@given(st.lists(st.text(st.sampled_from("aAäÄ/._-é:\udc80"), min_size=1), unique=True))
def test_no_two_views_share_a_name(views):
    names = image_names(views)
    assert len({n.casefold() for n in names.values()}) == len(views) and "" not in names.values()


def test_images_of_views_with_like_names_are_all_written(tmp_path):
    views, wanted = photos(5), ["a/b.png", "a_b.png", "A_B.jpg", "x" * 250 + ".png", "train.png"]
    for view, name in zip(views, wanted):
        object.__setattr__(view, "name", name)
    gaussians = initial_gaussians(seeds(), InitConfig(), 3, 1.0, torch.device("cpu"))
    evaluate_run(tmp_path, Renders(gaussians, RasterizeOptions()), views[4:], views[:4])
    for folder in ("renders", "depth"):
        assert len(list((tmp_path / folder).iterdir())) == 4
