"""The commands as a user types them: results, exit codes, help on one screen, and one line for every mistake."""

import dataclasses
import errno
import json
import os
import re
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from warpgs.app import cli
from warpgs.app.cli import COMMANDS, GROUPS, main
from warpgs.app.fit import request_of
from warpgs.app.flags import REMOVED, parse_flags
from warpgs.errors import UsageError
from warpgs.export.meshes_and_cameras import write_cameras
from warpgs.export.ply import read_ply
from warpgs.io.folder import READERS, Reader
from warpgs.io.load import SPECS
from warpgs.io.transforms import read_cameras
from warpgs.kernels.cameras import CAMERA_MODELS, CameraModel
from warpgs.pipeline.metrics.lpips import NETS, convert_lpips
from warpgs.pipeline.run.folder import open_run
from warpgs.pipeline.train.loss import LOSS_TERMS, LossTerm
from warpgs.pipeline.train.presets import PRESETS
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.strategies.base import STRATEGIES, Strategy
from warpgs.pipeline.train.view_modules import VIEW_MODULES
from warpgs.report import progress
from warpgs.synthetic.demo import split_spec


@pytest.fixture(scope="module")
def run(scene):
    out = scene.parent / "run"
    flags = ["--steps", "40", "--phases.least", "5", "--out", str(out), "--device", "cpu"]
    assert main(["fit", str(scene), "--split", split_spec(9), *flags]) == 0
    return out


@pytest.mark.parametrize(("words", "said"), [(["--help"], "doctor"), (["fit", "--help"], "--preset")])
def test_help_imports_nothing_heavy(words, said):
    heavy = "{'torch', 'warp', 'cv2', 'numpy', 'tyro'}"
    code = f"import sys; from warpgs.app.cli import main; main({words}); print({heavy} & {{*sys.modules}})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "set()" and said in done.stdout


def test_a_fit_starts_without_libraries_that_it_does_not_need_yet(scene, tmp_path):
    """After the first step: no search trees, no metrics, no 3D overview, no networks, no compiler of torch's, no algebra."""
    code = (
        "import sys\n"
        "from warpgs.app.cli import main\n"
        "from warpgs.pipeline.train import trainer\n"
        "advance = trainer.Trainer.advance\n"
        "def once(*a): advance(*a); raise KeyboardInterrupt\n"
        "trainer.Trainer.advance = once\n"
        f"flags = ['--out', {str(tmp_path / 'run')!r}, '--device', 'cpu', '--init.source', 'random']\n"
        f"code = main(['fit', {str(scene)!r}, *flags])\n"
        "late = {'scipy', 'skimage', 'sympy', 'pyvista', 'onnxruntime', 'torch._dynamo', 'torch._inductor'}\n"
        "print(code, sorted(late & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip().endswith("130 []")


def test_run_folder_holds_what_it_promises(run, scene):
    metrics = json.loads((run / "metrics.json").read_text())
    config = json.loads((run / "config.json").read_text())
    assert len(metrics["views"]) == len(config["test"]) > 0 and set(config["train"]).isdisjoint(config["test"])
    assert metrics["test"]["psnr"] == pytest.approx(np.mean([v["psnr"] for v in metrics["views"]]))
    assert {"warpgs", "torch", "warp-lang"} <= set(config["versions"]) and len(config["fingerprint"]) == 64
    assert len((run / "metrics.jsonl").read_text().splitlines()) == 40
    for name in config["test"]:
        assert (run / "renders" / name).is_file() and (run / "depth" / name).is_file()
    protocol = metrics["protocol"]
    assert protocol["split"] == split_spec(9) and protocol["ground_truth"] == "images as stored"
    assert protocol["resolution"] == ["64 x 48"] and protocol["held_out_views"] == len(config["test"])
    assert metrics["variants"]["lpips"].startswith("not measured") and "8 bits" in metrics["variants"]["psnr"]
    assert metrics["config_hash"] == config["config_hash"]
    page = (run / "report.html").read_text()
    assert "images as stored" in page and "not measured" in page and metrics["config_hash"] in page
    assert f"{metrics['test']['psnr']:.2f} dB" in page and "pixels by sweep" in page
    assert len(read_ply(run / "point_cloud.ply")) == metrics["gaussians"]
    events, layers = metrics["events"], metrics["layers"]
    assert 0 < events["added"] <= 0.03 * 6 * 64 * 48 * events["count"] and sum(layers.values()) == metrics["gaussians"]
    assert "Why Gaussians were placed" in page and len(list((run / "sampling").glob("*.png"))) == 2
    lines = (scene / "sparse" / "0" / "points3D.txt").read_text().splitlines()  # whose coordinates the file has
    points = np.array([line.split()[1:4] for line in lines if not line.startswith("#")], float)
    means = read_ply(run / "point_cloud.ply").means.numpy()
    low, high = np.percentile(points, [5, 95], axis=0)
    assert ((means > low - 0.3 * (high - low)) & (means < high + 0.3 * (high - low))).all(1).mean() > 0.8
    memory = metrics["memory"]
    assert 0 < memory["planned"] < memory["planned_at_cap"] and memory["limit"] is None and "memory: a step takes " in page


def test_eval_repeats_the_scores_and_measures_lpips(run, capsys, tmp_path):
    assert main(["eval", str(run), "--device", "cpu"]) == 0
    metrics = json.loads((run / "metrics.json").read_text())
    assert f"PSNR {metrics['test']['psnr']:.2f} dB" in capsys.readouterr().out.splitlines()[-1]
    assert json.loads((run / "eval.json").read_text())["test"] == metrics["test"]
    torch.manual_seed(0)
    net = NETS["alex"]
    state = {name: torch.randn(shape).abs() / 10 for name, shape in net.shapes().items()}
    torch.save({k: v for k, v in state.items() if k.startswith("features")}, tmp_path / "b.pth")
    torch.save({k: v for k, v in state.items() if k.startswith("lin")}, tmp_path / "h.pth")
    convert_lpips(tmp_path / "b.pth", tmp_path / "h.pth", tmp_path / "l.safetensors")
    assert main(["eval", str(run), "--device", "cpu", "--lpips-weights", str(tmp_path / "l.safetensors")]) == 0
    assert "LPIPS-Alex [0, 1]" in capsys.readouterr().out
    result = json.loads((run / "eval.json").read_text())
    assert result["test"]["lpips_alex_legacy"] == pytest.approx(np.mean([v["lpips_alex_legacy"] for v in result["views"]]))
    assert "[-1, 1]" in result["variants"]["lpips_alex_standard"] and result["steps"] == 40 and len(result["config_hash"]) == 12
    foreign = str(run / "point_cloud.ply")
    assert "warpgs convert-lpips" in failure(capsys, 3, "eval", str(run), "--lpips-weights", foreign)


@pytest.mark.parametrize(("path", "pictures"), [("auto", 4), ("turntable", 4), ("spiral", 4), ("interpolate", 4), ("views", 9)])
def test_render_paths(run, tmp_path, path, pictures, capsys, monkeypatch):
    monkeypatch.setattr("warpgs.pipeline.run.commands.h264_encoder", lambda: None)
    flags = ["--path", path, *([] if path == "views" else ["--frames", "4"]), "--out", str(tmp_path), "--sheet"]
    assert main(["render", str(run), *flags, "--device", "cpu"]) == 0
    assert len(list(tmp_path.glob("*.png"))) == pictures + 1 and (tmp_path / "film.mp4").stat().st_size > 0
    said = capsys.readouterr().out
    assert said.startswith("the film will be VP9, ") and said.count("install ffmpeg") == 1
    assert f"rendering: 0 of {pictures} frames\n" in said
    assert f"sheet of {min(6, pictures)} frames in {tmp_path / 'sheet.png'}" in said
    if path == "spiral":  # the advice is not repeated, except for a film that shall be .mp4
        for out, times in ((tmp_path, 0), (tmp_path / "a.webp", 0), (tmp_path / "a.mp4", 1), (tmp_path / "a.mp4", 1)):
            assert main(["render", str(run), "--path", path, "--frames", "2", "--out", str(out), "--device", "cpu"]) == 0
            assert capsys.readouterr().out.count("install ffmpeg") == times


@pytest.mark.parametrize("words", [["--color", "coverage"], ["--points", "start", "--background", "black"], ["--no-cameras"]])
def test_plot(run, tmp_path, capsys, words):
    target = tmp_path / "a.png"
    assert main(["plot", str(run), "--out", str(target), "--size", "320x240", "--device", "cpu", *words]) == 0
    image, said = cv2.imread(str(target)), capsys.readouterr().out
    assert image.shape == (240, 320, 3) and len(np.unique(image.reshape(-1, 3), axis=0)) > 100
    assert ("points of the reconstruction" if "start" in words else " Gaussians, ") in said


def test_choices_that_cannot_be_are_refused(run, capsys):
    for words, why in (
        ("--points stars", "'start')"), ("--color red", "'coverage')"), ("--size 9 9", "64 to 8192"),
        ("--background red", "'black')"), ("--out a.jpg", "is a .png"),
        ("--points start --color coverage", "coverage needs Gaussians"),
    ):  # fmt: skip
        assert why in failure(capsys, 2, "plot", str(run), *words.split())
    assert "'flow')" in failure(capsys, 2, "priors", "show", str(run), "--out", str(run), "--source", "lidar")
    assert "'slurm')" in failure(capsys, 2, "farm", str(run), "--out", str(run), "--engine", "pbs")


@pytest.mark.parametrize("command", ["export", "convert"])
def test_a_terminal_names_the_file_being_written(run, tmp_path, monkeypatch, command):
    lines = []
    monkeypatch.setattr(progress, "is_live", lambda: True)
    monkeypatch.setattr(progress._STATUS, "show", lines.append)
    target = tmp_path / "x.spz"
    words = [run, "--to", target] if command == "export" else [run / "point_cloud.ply", target]
    assert main([command, *map(str, words)]) == 0
    assert main(["export", str(run), "--to", str(tmp_path / "x.ply")]) == 0
    assert (tmp_path / "x.ply").read_bytes() == (run / "point_cloud.ply").read_bytes()
    assert lines[:2] == [f"starting {command}", "writing x.spz"]


@pytest.mark.parametrize("name", ["cameras.json", "transforms.json", "sparse"])
@pytest.mark.parametrize("flags", [[], ["--keep-names"], ["--keep-names", "--rotate", "0,0,1,90"]])
def test_cameras_for_other_trainers(run, scene, tmp_path, capsys, name, flags):
    """With the names of the photographs, if wanted; COLMAP's files have points, the most opaque Gaussians, rotated too."""
    target = tmp_path / name
    assert main(["export", str(run), "--to", str(target), *flags]) == 0
    found = [Path(n).name for n in read_cameras(target if name != "sparse" else tmp_path)[0]]
    photographs = sorted(p.name for p in (scene / "images").iterdir())
    numbers = [f"{i:04d}" + (".png" if name != "cameras.json" else "") for i in range(len(photographs))]
    assert found == (photographs if flags else numbers)
    said = capsys.readouterr().out
    assert ("their names are kept" if flags else "their names are numbers") in said
    if name == "sparse":
        made = read_ply(run / "point_cloud.ply")
        order = made.logit_opacities.argsort(descending=True, stable=True)
        wanted = made.means.double().numpy()[order]
        wanted = wanted @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]) if "--rotate" in flags else wanted
        rows = np.loadtxt(target / "0" / "points3D.txt")
        assert np.allclose(rows[:, 1:4], wanted, atol=1e-5) and f"of {len(made):,} Gaussians, for trainers" in said
        colors = np.clip(0.28209479 * made.sh[:, 0].numpy() + 0.5, 0, 1)[order]
        assert np.abs(rows[:, 4:7] - 255 * colors).max() <= 0.51
        pycolmap = pytest.importorskip("pycolmap")
        model = pycolmap.Reconstruction(str(target / "0"))
        assert len(model.points3D) == len(made) and sorted(i.name for i in model.images.values()) == found


def test_names_that_files_cannot_hold_and_data_that_have_changed(scene, run, tmp_path, capsys):
    camera = next(iter(open_run(run, "cpu").cameras("file").values()))
    with pytest.raises(UsageError, match=r"cannot hold the name 'a b\.png'; leave out --keep-names"):
        write_cameras(tmp_path / "sparse", [camera], ["images/a b.png"])
    write_cameras(tmp_path / "transforms.json", [camera], ["images/a b.png"])
    assert list(read_cameras(tmp_path / "transforms.json")[0]) == ["images/a b.png"] and not (tmp_path / "sparse").exists()
    assert "--keep-names requires cameras" in failure(capsys, 2, "export", str(run), "--to", "a.spz", "--keep-names")
    moved, copy = (Path(shutil.copytree(folder, tmp_path / folder.name)) for folder in (scene, run))
    record = json.loads((copy / "config.json").read_text())
    record["scene"]["path"] = str(moved)
    (copy / "config.json").write_text(json.dumps(record))
    (moved / "images" / "000.png").write_bytes((moved / "images" / "001.png").read_bytes())
    assert "have changed since the fit" in failure(capsys, 3, "eval", str(copy), "--device", "cpu")


def failure(capsys, code: int, *arguments: str) -> str:
    assert main(list(arguments)) == code
    text = capsys.readouterr().err.strip()
    assert text.splitlines()[-1].startswith("warpgs: ") and "Traceback" not in text and "internal error" not in text
    return text


def test_mistakes_get_one_line_and_their_exit_code(scene, run, tmp_path, capsys):
    out = str(tmp_path / "new")
    assert "unknown command 'photo'; choose one of demo" in failure(capsys, 2, "photo")
    for word, command in {"train": "fit", "run": "fit", "video": "render", "Movie": "render", "clean": "prune"}.items():
        assert f"unknown command '{word}'; did you mean {command}?" in failure(capsys, 2, word)
    assert "unknown command 'rendr'; did you mean render?" in failure(capsys, 2, "rendr")
    assert "--ouut" in (text := failure(capsys, 2, "mesh", str(run), "--ouut", out)) and "`warpgs mesh --help-all`" in text
    assert "--views INT" in failure(capsys, 2, "demo", "d", "--viewz", "3")
    assert "--height must be in [32, 8192], not 16" in failure(capsys, 2, "demo", "d", "--height", "16")
    assert "--init.fill-px" in failure(capsys, 2, "fit", str(scene), "--out", out, "--init.fill_pz=3")
    assert "choose another --out" in failure(capsys, 2, "fit", str(scene), "--out", str(run))
    assert "preset 'best'" in failure(capsys, 2, "fit", str(scene), "--out", out, "--preset", "best")
    fit = "fit", str(scene), "--out", out
    assert "device 'tpu'" in failure(capsys, 2, *fit, "--device", "tpu")
    assert "steps must be at least 1" in failure(capsys, 2, *fit, "--steps", "0")
    assert "--downscale must be at least 1" in failure(capsys, 2, *fit, "--downscale", "0")
    assert "no config.json" in failure(capsys, 2, *fit, "--resume")
    assert "no such folder" in failure(capsys, 3, "fit", str(tmp_path / "nowhere"), "--out", str(tmp_path / "b"))
    assert "no view 'x.png'" in failure(capsys, 3, "fit", str(scene), "--out", str(tmp_path / "c"), "--split", "train=x.png")
    assert "not understood" in failure(capsys, 2, "fit", str(scene), "--out", str(tmp_path / "d"), "--split", "third:3")
    assert "not the folder of a run (config.json" in failure(capsys, 3, "eval", str(tmp_path))
    (tmp_path / "begun" / "scene").mkdir(parents=True)
    (tmp_path / "begun" / "scene" / "poses.json").touch()
    assert "give its whole command again" in failure(capsys, 3, "fit", "--out", str(tmp_path / "begun"), "--resume")
    assert "no such folder" in failure(capsys, 3, "eval", str(tmp_path / "nowhere"))
    assert "no such file or folder; give a run" in failure(capsys, 3, "view", str(tmp_path / "nowhere"))
    (tmp_path / "my-run").mkdir()
    for command, *others in (("fit", "--out", out), ("eval",), ("view",)):
        said = failure(capsys, 3, command, str(tmp_path / "my-ran"), *others)
        assert "my-ran: no such f" in said and said.endswith("; did you mean my-run?")
    said = failure(capsys, 2, "convert", str(run), "a b.ply")
    assert f"is a run; use `warpgs export {run} --to 'a b.ply'`" in said
    (tmp_path / "model.spz").touch()
    assert "model.spz: not the folder of a run" in failure(capsys, 3, "eval", str(tmp_path / "model.spz"))
    again = ["fit", str(scene), "--split", split_spec(9), "--out", str(run), "--resume", "--device", "cpu", "--downscale", "2"]
    assert "a flag that changes them, like --downscale) differs from the run" in (said := failure(capsys, 2, *again))
    assert f"give only --out {run} --resume" in said
    assert "leave out --frames" in failure(capsys, 2, "render", str(run), "--path", "views", "--frames", "2")
    assert "--format requires --object" in failure(capsys, 2, "demo", out, "--format", "transforms")
    assert "colmap" in failure(capsys, 2, "demo", out, "--object", "--format", "ply")
    assert "--repeat was removed: the error of the fit" in failure(capsys, 2, "doctor", "--repeat", "not_finite.safetensors")
    assert "is the folder of a run" in failure(capsys, 2, "poses", str(run), "--out", out)
    assert "holds scenes, such as" in failure(capsys, 2, "poses", str(scene.parent), "--out", out)
    assert "path 'zigzag'" in failure(capsys, 2, "render", str(run), "--path", "zigzag")
    assert "format .obj is not supported" in failure(capsys, 2, "export", str(run), "--to", str(tmp_path / "a.obj"))
    assert not any((tmp_path / name).exists() for name in ("new", "b", "c", "d"))


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        ("render RUN out.mp4", "Unrecognized options: out.mp4"),
        ("render RUN --size 720 --fps 30", "--size takes two numbers: --size 1080 1920;"),
        ("plot RUN --size 720", "--size takes two numbers: --size 1080 1920;"),
        ("render --portrait RUN", "unknown flag --portrait; `warpgs render --help-all` lists the flags"),
        ("export RUN --to page.htm", "page.htm: format .htm is not supported; use one of"),
        ("view scene.html", "scene.html: is a web page; open this file in a browser"),
    ],
)
def test_words_in_the_wrong_place_get_the_right_command(run, tmp_path, monkeypatch, capsys, words, hint):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.html").touch()
    code = 3 if words.startswith("view") else 2
    text = failure(capsys, code, *[str(run) if w == "RUN" else w for w in words.split()])
    assert hint in text and "[bold]" not in text and [p.name for p in tmp_path.iterdir()] == ["scene.html"]


@pytest.mark.skipif(getattr(os, "geteuid", int)() == 0, reason="root, and Windows, may write anywhere")
def test_unwritable_output(scene, tmp_path, capsys):
    """A folder that cannot be written is found out before the scene is read."""
    tmp_path.chmod(stat.S_IRUSR | stat.S_IXUSR)
    assert "cannot be written" in failure(capsys, 4, "fit", str(scene), "--out", str(tmp_path / "x"))


def test_output_below_a_file_and_cuda_where_there_is_none(scene, capsys, tmp_path, monkeypatch):
    below = scene / "images" / "000.png" / "run"
    assert "cannot be written" in failure(capsys, 4, "fit", str(scene), "--out", str(below))
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    text = failure(capsys, 4, "fit", str(scene), "--out", str(tmp_path / "x"), "--device", "cuda")
    assert "warpgs doctor" in text and "--device cpu" in text


CUDA_FULL = "CUDA out of memory. Tried to allocate 48.00 MiB. GPU 0 has a total capacity of 139.80 GiB."
CPU_FULL = "[enforce fail at alloc_cpu.cpp:127] . DefaultCPUAllocator: can't allocate memory: you tried to allocate 9 bytes."
NO_MEMORY = [
    RuntimeError(CUDA_FULL), MemoryError(), RuntimeError(CPU_FULL), RuntimeError("std::bad_alloc"), OSError(errno.ENOMEM, "no"),
    RuntimeError("OpenCV(5.0.0) alloc.cpp:73: error: (-4:Insufficient memory) Failed to allocate 9 bytes"),
    RuntimeError("Failed to allocate 9 bytes on device 'cpu'"), RuntimeError("can't start new thread"),
    ImportError("libx.so: failed to map segment from shared object"),
]  # fmt: skip


@pytest.mark.parametrize("ask", [lambda: torch.empty(2**60), lambda: np.zeros((2**30, 2**24))])
def test_what_libraries_say_where_the_cpu_has_no_memory(ask, capsys, monkeypatch):
    """Their own words, which may change with their versions: more than any machine has is asked for."""
    monkeypatch.setattr("warpgs.pipeline.run.export.export", lambda *_: ask())
    assert "out of memory (" in failure(capsys, 4, "export", "run", "--to", "x.ply")


NUMBERS = ["inf", "nan", "1e400", "9" * 400, "", "0x10", "-1", "1e-400000"]
FIT_FLAGS = ("--steps", "--init.opacity", "--downscale", "--threads", "--time-budget", "--memory-limit")
FLAGS = [
    *(pytest.param("fit scene --out run --device cpu", f, marks=pytest.mark.fault) for f in FIT_FLAGS),
    ("render run", "--frames"), ("render run", "--fps"), ("prune run", "--keep-psnr"), ("compare scene --out c", "--seeds"),
    *(("demo d", f) for f in ("--views", "--width", "--height", "--seed")), ("priors show scene --out s", "--threads"),
]  # fmt: skip


@pytest.mark.parametrize(("command", "flag"), FLAGS)
def test_numbers_at_their_extremes(tmp_path, capsys, monkeypatch, command, flag):
    """Not finite, beyond every range, negative, empty, in other digits: exit code 2, words, and nothing is made."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene").mkdir()
    for number in NUMBERS:
        try:
            code = main([*command.split(), f"{flag}={number}"])
        except SystemExit as e:
            code = e.code
        text = capsys.readouterr().err
        assert code == 2 and text and "Traceback" not in text, (flag, number, code, text)
    assert [p.name for p in tmp_path.iterdir()] == ["scene"]


@pytest.mark.parametrize("error", NO_MEMORY, ids=lambda e: str(e)[-20:])
def test_limits_of_the_system_are_no_defects(error, capsys, monkeypatch):
    def full(*_):
        raise error

    monkeypatch.setattr("warpgs.pipeline.run.export.export", full)
    line = failure(capsys, 4, "export", "run", "--to", "x.ply")
    assert "out of memory (" in line and "End other programs" in line and "total capacity" not in line and "ulimit" in line


@pytest.mark.parametrize("program", [["-m", "warpgs"], ["-c", "import sys; from warpgs.app.cli import main; sys.exit(main())"]])
def test_a_deleted_working_folder_is_named(program, tmp_path):
    gone = tmp_path / "gone"
    gone.mkdir()
    words = ["sh", "-c", 'rmdir "$PWD"; exec "$@"', "sh", sys.executable, "-P", *program, "fit", "scene", "--out", "run"]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    done = subprocess.run(words, cwd=gone, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert (done.returncode, done.stderr) == (
        2,
        f"warpgs: the current folder was deleted ({os.strerror(errno.ENOENT)}); change to another one\n",
    )


def test_defects_are_called_defects(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("warpgs.pipeline.run.export.export", lambda *a: 1 / 0)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert main(["export", "run", "--to", "x.ply"]) == 5
    text = capsys.readouterr().err
    assert "internal error, ZeroDivisionError" in text and "Traceback" not in text
    assert "Traceback" in next(tmp_path.glob("warpgs-error-*.txt")).read_text()
    monkeypatch.setitem(sys.modules, "pyvista", None)
    monkeypatch.setattr("warpgs.pipeline.run.export.export", lambda *a: __import__("pyvista"))
    assert "the Python package pyvista, which is missing" in failure(capsys, 2, "export", "run", "--to", "x.ply")


def test_demo_command_tells_the_next_step(tmp_path, capsys, monkeypatch):
    """The printed command is short, and is one that reads; a shell takes it as it is."""
    assert main(["demo", str(tmp_path / "a d"), "--views", "8", "--width", "48", "--height", "36"]) == 0
    assert f"next: warpgs fit '{tmp_path / 'a d'}' --split every:8 --out run" in capsys.readouterr().out
    size = ["--views", "9", "--width", "32", "--height", "32"]
    assert main(["demo", str(tmp_path / "o"), "--object", "--format", "colmap", *size]) == 0
    assert "--split llff:8 --masks cutout --out" in capsys.readouterr().out
    assert main(["--version"]) == 0
    monkeypatch.setitem(REMOVED, "--old-name", "use --new-name")
    assert main(["demo", "d", "--old_name=3"]) == 2
    assert capsys.readouterr().err == "warpgs: --old-name was removed: use --new-name\n"


# Help on one screen: what it says is what the code does, and it imports nothing that takes time.

BASE = ["SCENE", "--out", "RUN"]
SCENE_FIELDS = {"split", "downscale", "max_side", "masks", "depths"}


def printed(capsys, *words):
    assert main(list(words)) == 0
    return capsys.readouterr().out.splitlines()


@pytest.mark.parametrize("words", [["fit", "scene", "-h"], ["--help"]])
def test_help_fits_one_screen(capsys, words):
    lines = printed(capsys, *words)
    assert sorted(name for names in GROUPS.values() for name in names) == sorted(COMMANDS)
    if words == ["--help"]:
        text = "\n".join(lines)
        assert all(f"\n{purpose}:\n" in text for purpose in GROUPS) and all(about in text for about in COMMANDS.values())
    assert 20 < len(lines) <= 45 and max(map(len, lines)) <= 80


def test_the_help_of_a_command_is_that_of_the_parser(capsys):
    """Every flag with its description and default, by either word."""
    text = "\n".join(printed(capsys, "priors", "--help"))
    assert "warpgs priors show SCENE" in text and "warpgs priors export --model" in text and "--help" in text
    for name, stated in {
        "farm": ["--per-gpu INT", "share a GPU. (default: 1)"],
        "plot": ["--cameras, --no-cameras", "Show the cameras. (default: True)", "(default: 1600 1000)"],
        "compare": ["Scene folders.", "--out PATH", "--black-is-empty", "quick: a first look"],
        "convert": ["File of Gaussians to read", "--spz.version INT", "--no-clean"],
        "export": ["File to write", "  .html: a page"],
        "priors show": ["--depth-model", "Folder for PNG sheets"],
        "priors export": ["--model", "ONNX file to write"],
    }.items():
        for word in ("-h", "--help-all"):
            with pytest.raises(SystemExit) as end:
                main([*name.split(), word])
            text = capsys.readouterr().out
            assert end.value.code == 0 and [part for part in stated if part not in text] == [], name


@dataclasses.dataclass(frozen=True)
class Open:
    switch: bool | None = True
    whole: int | None = 1
    number: float | None = 1.0


def test_open_settings_take_none_and_switches_in_any_case():
    for words, found in {
        "--switch none --whole none --number None": Open(None, None, None), "--switch true --whole 3": Open(True, 3),
        "--switch False --number 2": Open(False, 1, 2.0),
    }.items():  # fmt: skip
        assert parse_flags(Open, words.split(), "warpgs fit", "") == found


@pytest.mark.parametrize(("flag", "word", "default"), [f[:3] for f in cli.FLAGS if f[0] != "--out"])
def test_flags_and_their_defaults_are_those_of_the_parser(flag, word, default):
    """A flag is a switch where it has no value, and what it does not say of itself is None."""
    request = request_of(BASE, "")
    name = flag.removeprefix("--").replace("-", "_")
    owner = request.scene if name in SCENE_FIELDS else request if name in ("device", "resume") else request.config
    if name == "view":
        value = request.view_port is not None
    elif name in VIEW_MODULES.names():
        value = name in [m.name for m in request.config.view_modules]
    else:
        value = getattr(owner, name)
    assert default == ("" if value is None else str(value)) and (word == "") == isinstance(value, bool)
    if not word:
        assert request_of([*BASE, flag], "") != request


def test_what_is_registered_is_in_the_help(capsys, monkeypatch):
    monkeypatch.setattr(PRESETS, "_made", dict(PRESETS._made))
    monkeypatch.setattr(PRESETS, "_about", dict(PRESETS._about))
    PRESETS.register("mine", PRESETS["quick"], "one of my own")
    assert "  mine           one of my own" in printed(capsys, "fit", "--help")
    kinds = {STRATEGIES: Strategy, LOSS_TERMS: LossTerm, READERS: Reader, CAMERA_MODELS: CameraModel}
    for registry, base in kinds.items():
        registry.names()
        monkeypatch.setattr(registry, "_classes", dict(registry._classes))
        registry.register("my_" + registry.kind.replace(" ", "_"))(type("Mine", (base,), {"__doc__": "A part of mine. More."}))
    with pytest.raises(SystemExit):
        main(["fit", "--help-all"])
    text = capsys.readouterr().out
    for registry in kinds:
        lines = registry.described()
        assert lines["my_" + registry.kind.replace(" ", "_")] == "A part of mine" and all(lines.values())
        assert all(" ".join(f"{name}: {about}".split()) in " ".join(text.split()) for name, about in lines.items())
    assert all(f"{name}: {about}" in " ".join(text.split()) for name, about in PRESETS.described().items())


def test_choices_steps_and_flags_are_those_of_the_code(capsys):
    """--help-all is the help of the parser, with every flag of the short one and those of the groups."""
    assert sorted(", ".join(cli.SPLITS).split(", ")) == sorted(re.split(r", (?:or )?", SPECS))
    text, fields = {f[0]: f[3] for f in cli.FLAGS}, request_of(BASE, "").config
    for color in re.findall(r"auto|mean|scene|black|white", text["--background"]):
        dataclasses.replace(fields, background=color)
    for how in ("ignore", "cutout"):
        assert how in text["--masks"] and request_of([*BASE, "--masks", how], "").scene.masks == how
    for name, line in PRESETS.described().items():
        stated, config = re.search(r"([0-9]+) steps", line), PRESETS[name]
        assert (int(stated[1]) if stated else FitConfig().max_steps) == (config.steps or config.max_steps)
    with pytest.raises(SystemExit) as end:
        main(["fit", "--help-all"])
    text = capsys.readouterr().out
    assert end.value.code == 0 and all(name in text for name, *_ in cli.FLAGS)
    assert "--stopping.min-gain-db" in text and len(text.splitlines()) > 200
    for line in cli.EXAMPLES:
        program, command, *words = line.split()
        assert (program, command) == ("warpgs", "fit") and request_of(words, "").out.name == "run"
