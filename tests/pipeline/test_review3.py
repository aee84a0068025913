"""Faults that a review found: each test fails at 37ffefc1."""

import shutil
from pathlib import Path

import pytest

from warpgs.app.cli import main
from warpgs.synthetic.demo import write_demo

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo") / "scene"
    write_demo(folder, views=8, width=64, height=48)
    return folder


def fitted(scene, tmp_path, *flags):
    shutil.copy(ROOT / "examples/05_own_strategy.py", tmp_path / "own.py")
    assert main(["fit", str(scene), "--out", "run", "--steps", "3", "--device", "cpu", *flags]) == 0


def test_a_strategy_that_the_run_does_not_have_is_refused(scene, tmp_path, monkeypatch, capsys):
    """`--strategy` is ignored silently: at f9dc4ad9 the fit ended with 'config (strategy, ...) differs'."""
    monkeypatch.chdir(tmp_path)
    fitted(scene, tmp_path)
    assert main(["fit", str(scene), "--out", "run", "--resume", "--device", "cpu", "--strategy", "own.py:Sprout"]) != 0


def test_the_named_command_works_from_another_folder(scene, tmp_path, monkeypatch, capsys):
    """The message names own.py as the fit's command did, relative to its folder; the stored absolute path is refused."""
    monkeypatch.chdir(tmp_path)
    fitted(scene, tmp_path, "--strategy", "own.py:Sprout")
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path / "other")
    words = ["fit", "--out", "../run", "--resume", "--device", "cpu", "--strategy", f"{tmp_path / 'own.py'}:Sprout"]
    assert main(words) == 0


def test_a_toml_preset_on_a_drive_is_no_code(scene, tmp_path, monkeypatch, capsys):
    r"""``--preset C:\mine.toml``: any path with a colon shows it."""
    monkeypatch.chdir(tmp_path)
    Path("C:").mkdir()
    Path("C:/mine.toml").write_text("steps = 3\n")
    fitted(scene, tmp_path, "--preset", "C:/mine.toml")
    again = ["fit", str(scene), "--out", "run", "--steps", "3", "--device", "cpu", "--preset", "C:/mine.toml", "--resume"]
    assert main(again) == 0
    assert main([w for w in again if w not in ("--steps", "3")]) == 0
