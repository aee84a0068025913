"""Names of files that are not UTF-8, in every command; and Python that takes names for another encoding."""

import contextlib
import csv
import io
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from warpgs import process
from warpgs.app.cli import main
from warpgs.errors import UsageError
from warpgs.files import readable, write_text
from warpgs.io.load import load_scene
from warpgs.poses.photographs import _frames, scene_name
from warpgs.process import utf8_name
from warpgs.report.film import write_film
from warpgs.synthetic.demo import write_demo, write_object

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="names are text on this system")
BYTES = os.fsdecode(b"b\xe4\xc3\xbc")
"""A name of three letters, the second of which is Latin-1 and the third UTF-8."""
CPU = ["--device", "cpu"]


def test_bytes_that_are_no_text_are_printed_as_codes(tmp_path):
    assert readable(f"{BYTES} \ud800") == "b\\xe4ü \\ud800"
    write_text(tmp_path / BYTES, BYTES)
    assert (tmp_path / BYTES).read_text("utf-8") == "b\\xe4ü"
    assert scene_name(f"a/{BYTES}.png", b"\x89PNG\r\n\x1a\n") == "a/b%E4ü.png"


def test_a_name_that_a_library_can_take(tmp_path, monkeypatch):
    """A file in a folder of such a name, and one that has such a name itself."""
    folder = tmp_path / BYTES
    folder.mkdir()
    for path in (folder / "file", folder / f"{BYTES}.txt", tmp_path / "plain"):
        path.write_bytes(b"content")
        with utf8_name(path) as name:
            assert Path(name.encode("utf-8").decode()).read_bytes() == b"content"
    with utf8_name(folder / "new") as name:
        Path(name).write_bytes(b"new")
    assert (folder / "new").read_bytes() == b"new"
    monkeypatch.setattr(process, "DESCRIPTORS", tmp_path / "none")
    with pytest.raises(UsageError, match=r"b\\xe4ü/file: the name is not UTF-8"), utf8_name(folder / "file"):
        pass


@pytest.mark.parametrize("suffix", [".mp4", ".webm", ".gif"])
def test_films(tmp_path, suffix):
    """OpenCV ended the process at such a name; a film is written, checked and read."""
    path = tmp_path / BYTES / f"{BYTES}{suffix}"
    path.parent.mkdir()
    frames = [np.full((16, 16, 3), 0.2 * i, np.float32) for i in range(3)]
    assert write_film(path, frames) == 3 and [p.name for p in path.parent.iterdir()] == [path.name]
    if suffix != ".gif":
        assert len(list(_frames(path))) == 3


def rename_an_image(scene: Path) -> str:
    """Give the first image of a COLMAP scene such a name, in its file of images too; return it."""
    old = min((scene / "images").glob("*.png"))
    new = f"{BYTES}.png"
    old.rename(scene / "images" / new)
    file = scene / "sparse" / "0" / "images.txt"
    file.write_bytes(file.read_bytes().replace(os.fsencode(old.name), os.fsencode(new)))
    return new


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("names") / BYTES / f"scene{BYTES}"
    write_demo(folder, views=8, width=48, height=36)
    rename_an_image(folder)
    return folder


def flags(steps, preset="3dgs"):
    few = ["--init.source", "random", "--init.random-count", "50"] if preset == "3dgs" else []
    return ["--split", "every:4", "--steps", str(steps), *CPU, "--preset", preset, *few]


def test_a_fit_and_what_follows(scene, tmp_path, capsys):
    """The run remembers its scene, and is continued, scored and shown; reports hold text."""
    run = tmp_path / BYTES
    assert main(["fit", str(scene), "--out", str(run), *flags(2)]) == 0
    record = json.loads((run / "config.json").read_bytes())
    assert record["scene"]["path"] == str(scene) and f"{BYTES}.png" in record["cameras"]
    page = (run / "report.html").read_text("utf-8")
    assert "b\\xe4ü" in page and not any("\ud800" <= c <= "\udfff" for c in page)
    assert all(process.is_utf8(p.name) for p in (run / "renders").iterdir())
    assert main(["fit", "--out", str(run), "--resume"]) == 0
    assert main(["eval", str(run), *CPU]) == 0
    assert main(["render", str(run), "--frames", "2", "--path", "turntable", *CPU]) == 0
    assert main(["export", str(run), "--to", str(tmp_path / f"{BYTES}.spz")]) == 0
    printed = capsys.readouterr().out
    assert "b\\xe4ü" in printed and BYTES not in printed


def test_transforms(tmp_path):
    """Names in JSON: as bytes that are no text, and as the escapes that Python's JSON has for them."""
    write_object(tmp_path / "scene", views=9, width=32, height=32, seed=0, form="transforms")
    file = tmp_path / "scene" / "transforms.json"
    text, image = file.read_text("utf-8"), min((tmp_path / "scene").rglob("*.png"))
    new = image.with_name(f"{BYTES}.png")
    image.rename(new)
    for form in (os.fsencode(new.name), json.dumps(new.name).strip('"').encode()):
        file.write_bytes(text.encode().replace(image.name.encode(), form))
        assert any(v.name.endswith(new.name) for v in load_scene(tmp_path / "scene").views)


@pytest.mark.slow
def test_the_farm(scene, tmp_path):
    """A job's folder has such a name; the page links to it, and the table holds text."""
    out = tmp_path / BYTES
    assert main(["farm", str(scene.parent), "--out", str(out), *flags(1)]) == 0
    page, (row,) = (
        (out / "index.html").read_text("utf-8"),
        csv.DictReader(io.StringIO((out / "results.csv").read_text("utf-8"))),
    )
    assert row["name"] == "sceneb\\xe4ü" and row["state"] == "done"
    assert "sceneb%E4%C3%BC/run/report.html" in page and "sceneb%E4%C3%BC/thumbnail.jpg" in page
    assert cv2.imdecode(np.fromfile(out / scene.name / "thumbnail.jpg", np.uint8), cv2.IMREAD_COLOR) is not None


def test_plug_ins(scene, tmp_path):
    """A reader's file has such a name."""
    file = tmp_path / f"{BYTES}.py"
    file.write_text("from warpgs.io.colmap import ColmapReader\nclass Own(ColmapReader):\n    pass\n")
    assert main(["fit", str(scene), "--out", str(tmp_path / "run"), "--reader", f"{file}:Own", *flags(1)]) == 0


@pytest.mark.slow
def test_the_other_commands(scene, tmp_path, monkeypatch):
    """Also where the folders of temporary files, of warpgs's cache and the current one have such names."""
    work, run = tmp_path / BYTES, str(tmp_path / BYTES / "run")
    (work / "tmp").mkdir(parents=True)
    monkeypatch.setenv("WARPGS_CACHE", str(work / "cache"))
    monkeypatch.setenv("TMPDIR", str(work / "tmp"))
    monkeypatch.setattr("tempfile.tempdir", None)
    monkeypatch.chdir(work)
    assert main(["fit", str(scene), "--out", run, *flags(30, "quick")]) == 0
    film = str(work / f"{BYTES}.webm")
    for words in (
        ["plot", run, *CPU],
        ["render", run, "--out", film, "--frames", "2", *CPU],
        ["render", run, "--path", "views", "--sheet", *CPU],
        ["export", run, "--to", f"{BYTES}.html"],
        ["export", run, "--to", f"{BYTES}/sparse"],
        ["export", run, "--to", f"{BYTES}.ply"],
        ["render", f"{BYTES}.ply", "--cameras", str(scene), "--rule", "exact", "--out", f"{BYTES}.gif", "--frames", "2", *CPU],
        ["convert", f"{BYTES}.ply", f"{BYTES}.sog"],
        ["mesh", run, "--out", f"{BYTES}.glb", "--resolution", "16", *CPU],
        ["prune", run, "--keep-psnr", "3", *CPU],
        ["priors", "show", str(scene), "--split", "every:4", "--out", "priors"],
        ["compare", str(scene), "--out", "study", "--presets", "3dgs,mcmc", "--seeds", "1", *flags(1)[:6]],
        ["demo", f"{BYTES}demo", "--views", "8", "--width", "32", "--height", "32"],
    ):
        assert main(words) == 0, words
    table = (work / "study" / "runs.csv").read_text("utf-8")
    assert "sceneb\\xe4ü" in table


@pytest.mark.slow
def test_poses(tmp_path, capfd):
    """Photographs and their folder have such names; the scene's names are text, as COLMAP needs."""
    pytest.importorskip("pycolmap")
    write_demo(tmp_path / "demo", views=8, width=320, height=240)
    photographs = tmp_path / BYTES
    shutil.copytree(tmp_path / "demo" / "images", photographs)
    first = min(photographs.iterdir())
    first.rename(first.with_name(f"{BYTES}.png"))
    code = main(["poses", str(photographs), "--out", str(tmp_path / f"{BYTES}out")])
    assert code in (0, 3), capfd.readouterr().err
    if code == 0:
        assert load_scene(tmp_path / f"{BYTES}out").views


def shell(words: list[str], environment: dict[str, str]) -> subprocess.CompletedProcess[bytes]:
    """Run a command in an environment of its own."""
    own = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(Path(__file__).parents[2])} | environment
    program = [sys.executable, "-P", "-m", "warpgs", *words]
    return subprocess.run(program, env=own, capture_output=True, check=False, timeout=300)


def test_python_that_takes_names_for_ascii(tmp_path):
    """It is started again in its UTF-8 mode, once, which is said; letters are printed as the terminal has them."""
    ascii_names = {"LC_ALL": "C", "PYTHONUTF8": "0"}
    done = shell(["demo", str(tmp_path / "写"), "--views", "8", "--width", "32", "--height", "32"], ascii_names)
    said = done.stderr.decode("ascii")
    assert done.returncode == 0 and (tmp_path / "写" / "sparse").is_dir(), said
    assert said.count("UTF-8 mode") == 1 and said.count("\n") == 1 and b"\\u5199" in done.stdout
    assert shell(["--version"], {"LC_ALL": "C.UTF-8", "PYTHONUTF8": "0"}).stderr == b""


def test_starting_again_keeps_the_command(monkeypatch):
    """The words, the interpreter's own options, and nothing twice."""
    called: list[list[str]] = []
    monkeypatch.setattr(os, "execv", lambda program, words: called.append([program, *words]))
    monkeypatch.setattr(os, "environ", dict(os.environ))
    monkeypatch.setattr(sys, "getfilesystemencoding", lambda: "iso8859-1")
    monkeypatch.setattr(sys, "orig_argv", ["python", "-P", "-m", "warpgs", "fit"])
    with contextlib.suppress(SystemExit):
        process.use_utf8_names()
    mode = [] if sys.flags.utf8_mode else [[sys.executable, sys.executable, "-X", "utf8", "-P", "-m", "warpgs", "fit"]]
    assert called == mode and (not mode or os.environ["PYTHONUTF8"] == "1")
