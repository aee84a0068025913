"""A run folder belongs to one fit at a time, and to one fit for good."""

import dataclasses
import json
import os
import shutil

import pytest

import warpgs
from warpgs.app.cli import main
from warpgs.errors import DataError, FolderHeldError, ResourceError, UsageError
from warpgs.files import LOCK
from warpgs.locks import hold_folder
from warpgs.pipeline.farm import work
from warpgs.pipeline.films.film import FilmSettings
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.run import fit as fit_module
from warpgs.pipeline.run.commands import evaluate, render
from warpgs.pipeline.run.export import export
from warpgs.pipeline.run.folder import TENSORS
from warpgs.pipeline.run.request import FitRequest, SceneRequest
from warpgs.synthetic.demo import write_demo

CONFIG = warpgs.FitConfig(steps=2, init=InitConfig(source="random", random_count=50))
LEFT = ".warpgs-0123456789abcdef.tmp"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A scene and a run on it."""
    folder = tmp_path_factory.mktemp("folders")
    write_demo(folder / "scene", views=8, width=32, height=32)
    warpgs.fit(folder / "scene", CONFIG, out=folder / "run", device="cpu", verbose=False)
    return folder


def fit(folder, out, config=CONFIG, **options):
    """Fit the scene on the CPU, silently."""
    return warpgs.fit(folder / "scene", config, out=out, device="cpu", verbose=False, **options)


def contents(folder):
    """Every file with its bytes."""
    return {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_a_second_fit_into_a_folder_is_refused(folder, tmp_path, monkeypatch):
    """It comes while the first reads its scene, before there is any file to see; the first ends as if alone."""
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
        with pytest.raises(ResourceError, match="is writing there"):
            fit(folder, run, resume=True)
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


def test_export_and_prune_remove_what_killed_ones_left(folder, tmp_path):
    """Files and folders under temporary names; the user's own stay."""
    run, cpu = str(folder / "run"), ["--device", "cpu"]
    for words in (["export", run, "--to", str(tmp_path / "a.ply")], ["prune", run, "--out", str(tmp_path / "b"), *cpu]):
        (tmp_path / LEFT).mkdir()
        (tmp_path / LEFT / "config.json").touch()
        (tmp_path / LEFT.replace("0", "1")).touch()
        (tmp_path / "own.tmp").touch()
        assert main(words) == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.ply", "b", "own.tmp"]


def test_a_study_leaves_a_run_in_progress_alone(folder, tmp_path):
    """It neither moves it aside nor writes into it, and says whose it is."""
    out = tmp_path / "study" / "0"
    shutil.copytree(folder / "run", out)
    scene = warpgs.load_scene(folder / "scene")
    request = FitRequest(SceneRequest(str(folder / "scene")), out, dataclasses.replace(CONFIG, steps=3), "cpu")
    with hold_folder(out):
        outcome = work.ensure_run(request, scene.fingerprint, warpgs.open_run(out, "cpu"), "cpu", {})
    assert outcome.state == "failed" and "is writing there" in outcome.note
    assert [p.name for p in out.parent.iterdir()] == ["0"]


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
    word = "seed" if key == "config" else "fingerprint"
    with pytest.raises(DataError, match=f"and config.json beside it belong to different fits: {word} differs"):
        fit(folder, tmp_path / "run", resume=True)
    assert contents(tmp_path / "run") == before


def test_a_folder_in_use_names_its_user_and_does_not_advise_to_resume(folder, tmp_path):
    """Whether it holds a run already or not; a lock file that nobody holds is no user."""
    shutil.copytree(folder / "run", tmp_path / "run")
    with hold_folder(tmp_path / "run"), pytest.raises(FolderHeldError, match=f"process {os.getpid()} on .* is writing there"):
        fit(folder, tmp_path / "run")
    (tmp_path / "run" / LOCK).write_text("")
    with pytest.raises(UsageError, match="exists already; choose another --out, or continue that run with --resume"):
        fit(folder, tmp_path / "run")


def test_commands_on_a_run_that_has_not_ended_print_that(folder, tmp_path):
    """Render, export, page, evaluation and plot; none does for a finished run."""
    shutil.copytree(folder / "run", tmp_path / "run")
    commands = {
        "export": lambda: export(tmp_path / "run", tmp_path / "a.ply"),
        "eval": lambda: evaluate(tmp_path / "run", "cpu"),
        "render": lambda: render(tmp_path / "run", "views", tmp_path / "film", FilmSettings(), "cpu"),
    }
    assert not [line for c in commands.values() for line in c() if ": unfinished," in line]
    (tmp_path / "run" / "metrics.json").unlink()
    for name, command in commands.items():
        lines = [line for line in command() if "the fit stopped after step 2" in line]
        assert len(lines) == 1 and "--resume" in lines[0], name


def test_a_fit_that_was_killed_before_it_had_a_record_can_be_begun_again(folder, tmp_path):
    """The folder holds a lock file and half of config.json, which is as good as empty."""
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


def test_a_folder_of_the_users_own_outlives_an_error(folder, tmp_path):
    """Whatever the error; one that the fit made goes."""
    (tmp_path / "own").mkdir()
    for out in ("own", "made"):
        with pytest.raises(DataError, match="no such folder"):
            warpgs.fit(tmp_path / "nowhere", CONFIG, out=tmp_path / out, device="cpu")
    assert [p.name for p in tmp_path.iterdir()] == ["own"]


@pytest.mark.skipif(os.name == "nt", reason="Windows has other limits and rights")
def test_a_folder_that_cannot_be_made_or_read_is_the_users_matter(folder, tmp_path, capsys):
    """A name of 300 letters, and a folder without the right to look into it."""
    words = ["fit", str(folder / "scene"), "--device", "cpu", "--out"]
    for more in ([], ["--resume"]):
        assert main([*words, str(tmp_path / ("x" * 300)), *more]) in (2, 4)
        assert ("internal error" not in (said := capsys.readouterr().err) and "choose another" in said) or more
    if os.geteuid():
        (tmp_path / "shut").mkdir(mode=0)
        assert main([*words, str(tmp_path / "shut")]) == 4
        assert "may read and write" in capsys.readouterr().err
