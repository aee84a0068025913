"""Processes: nothing of the current folder runs, signals end in one sentence, names that are not UTF-8, other systems."""

import ast
import csv
import importlib
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest

from warpgs import process
from warpgs.app.cli import COMMANDS, main
from warpgs.errors import UsageError
from warpgs.files import readable, write_text
from warpgs.io.load import load_scene
from warpgs.pipeline.run.folder import load_checkpoint
from warpgs.poses.photographs import scene_name
from warpgs.process import ignored_signals, interrupting_signals, noted_signals, utf8_name
from warpgs.report.film import write_film
from warpgs.report.progress import EventLog
from warpgs.synthetic.demo import split_spec, write_demo, write_object

ROOT = Path(__file__).parent.parent.parent
PLANTED = (
    "pyvista", "vtk", "vtkmodules", "numpy", "torch", "PIL", "cv2", "warp", "scipy", "skimage", "rich", "tyro", "psutil",
    "onnxruntime", "safetensors", "matplotlib", "json", "random", "tempfile", "subprocess", "dataclasses", "platform",
    "sitecustomize", "usercustomize", "onnx", "transformers", "IPython", "numba", "sympy",
)  # fmt: skip
EARLY = ("typing", "contextlib", "gc", "importlib", "runpy", "pathlib")
"""Modules that `python -m` itself imports from the current folder before any line of ours runs (SECURITY.md)."""
PROGRAM = "import sys\nfrom warpgs.app.cli import main\nif __name__ == '__main__':\n    sys.exit(main())\n"
"""What pip writes as the program `warpgs`, for the entry in pyproject.toml."""


@pytest.fixture
def trap(tmp_path, monkeypatch):
    """A scene folder with modules of well-known names; each leaves a mark when it is run. Returns the folder and the mark."""
    folder, mark = tmp_path / "scene", tmp_path / "mark"
    write_demo(folder, views=8, width=48, height=36)
    for name in PLANTED:
        text = f"with open({str(mark)!r}, 'a') as f: f.write(__file__ + ' ')\nraise ImportError('planted')\n"
        (folder / f"{name}.py").write_text(text, "utf-8")
    monkeypatch.chdir(folder)
    return folder, mark


def run(*command: str, **more: str) -> subprocess.CompletedProcess:
    """Run Python as a user does who has installed warpgs: without any word on safe paths."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONSAFEPATH"} | {"PYTHONPATH": str(ROOT)} | more
    return subprocess.run(
        [sys.executable, *command], env=environment, capture_output=True, text=True, encoding="utf-8", check=False, timeout=300
    )


@pytest.fixture
def program(tmp_path):
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "warpgs").write_text(PROGRAM)
    return str(tmp_path / "bin" / "warpgs")


FIT = ["--split", split_spec(8), "--steps", "2", "--device", "cpu", "--init.source", "random", "--init.random-count", "50"]
SIZE = ["--views", "8", "--width", "32", "--height", "32"]
STUDY = ["--split", split_spec(8), "--steps", "2", "--device", "cpu", "--seeds", "1"]


def test_no_fit_runs_what_lies_beside_a_scene(trap, tmp_path):
    """Not even as `python -m`; plain Python from there runs a planted module."""
    _, mark = trap
    done = run("-m", "warpgs", "fit", ".", *FIT, "--out", str(tmp_path / "run"))
    assert done.returncode == 0, done.stdout + done.stderr
    assert not mark.exists(), mark.read_text()
    assert run("-c", "import pyvista").returncode == 1 and "pyvista.py" in mark.read_text()


@pytest.mark.parametrize("early", [True, False])
def test_the_program_runs_nothing_from_the_current_folder(trap, program, early):
    """Even with what Python imports first planted there."""
    folder, mark = trap
    for name in EARLY if early else ():
        (folder / f"{name}.py").write_text((folder / "json.py").read_text())
    for command in ([program], ["-P", "-m", "warpgs"]) if early else (["-m", "warpgs"],):
        done = run(*command, "demo", f"new{len(command)}", *SIZE)
        assert done.returncode == 0 and (folder / f"new{len(command)}" / "images").is_dir(), done.stderr
        assert not mark.exists(), mark.read_text()


@pytest.mark.fault
def test_no_command_runs_what_lies_beside_a_scene(trap, tmp_path, program):
    """Every command of the program, called in a scene that holds modules of well-known names, with all it starts."""
    folder, mark = trap
    out, jobs = str(tmp_path / "run"), tmp_path / "jobs.jsonl"
    jobs.write_text(json.dumps({"scene": str(folder)}))
    for name in EARLY:
        (folder / f"{name}.py").write_text((folder / "json.py").read_text())
    commands = {
        "help": (0, ["--help"]), "fit": (0, ["fit", ".", *FIT, "--out", out]), "eval": (0, ["eval", out, "--device", "cpu"]),
        "render": (0, ["render", out, "--frames", "2", "--path", "turntable", "--device", "cpu"]),
        "plot": (0, ["plot", out, "--device", "cpu"]),
        "export": (0, ["export", out, "--to", str(tmp_path / "a.ply")]), "prune": (0, ["prune", out, "--device", "cpu"]),
        "priors": (0, ["priors", "show", ".", "--out", str(tmp_path / "priors"), "--split", split_spec(8)]),
        "priors export": (2, ["priors", "export", "--model", "none", "--out", str(tmp_path / "a.onnx")]),
        "compare": (0, ["compare", ".", "--presets", "3dgs,mcmc", *STUDY, "--out", str(tmp_path / "compare")]),
        "ablate": (0, ["ablate", ".", "--preset", "quick", *STUDY, "--out", str(tmp_path / "ablate")]),
        "convert-lpips": (3, ["convert-lpips", "--backbone", "a.pth", "--heads", "b.pth", "--out", "c.safetensors"]),
        "demo": (0, ["demo", "new", "--views", "8", "--width", "32", "--height", "32"]), "doctor": (0, ["doctor"]),
        "view": (3, ["view", "."]), "convert": (3, ["convert", "a.ply", str(tmp_path / "b.spz")]),
        "poses": (0 if find_spec("pycolmap") else 4, ["poses", "images", "--out", str(tmp_path / "found")]),
        "farm": (0, ["farm", str(jobs), *FIT, "--out", str(tmp_path / "farm")]),
        "mesh": (3, ["mesh", out, "--out", str(tmp_path / "a.glb"), "--device", "cpu"]),
        "level": (0, ["level", out, "--up", "photographs"]),
    }  # fmt: skip
    assert {c.split()[0] for c in commands} == {"help", *COMMANDS}
    for name, (code, words) in commands.items():
        done = run(program, *words)
        assert done.returncode == code and not mark.exists(), f"{name}: {done.stdout}{done.stderr}"


STARTERS = {
    "os": ("system", "popen", "exec", "spawn", "posix_spawn", "startfile", "fork"),
    "asyncio": ("create_subprocess",), "subprocess": ("",), "multiprocessing": ("",), "pty": ("",), "commands": ("",),
    "concurrent.futures": ("ProcessPoolExecutor", "process"), "torch.multiprocessing": ("",), "runpy": ("",), "code": ("",),
}  # fmt: skip
"""Beginnings of names, by module, that start processes or shells, or run code by its path."""


def dotted(node: ast.AST) -> str:
    """The name of a module as it is written: a.b; something else for what is no name."""
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else "?"


def starters(path: Path) -> list[str]:
    tree = ast.parse(path.read_text("utf-8"))
    found, names = [], {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {a.asname or a.name.split(".")[0]: a.name if a.asname else a.name.split(".")[0] for a in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module in STARTERS:
            found += [f"{node.module}.{a.name}" for a in node.names if a.name.startswith(STARTERS[node.module])]
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, (ast.Name, ast.Attribute)):
            head, dot, rest = dotted(node.value).partition(".")
            module = names.get(head, "") + dot + rest
            found += [f"{module}.{node.attr}"] * (module in STARTERS and node.attr.startswith(STARTERS[module]))
        elif isinstance(node, ast.keyword) and node.arg == "shell":
            found.append("shell=")
    return found


def test_one_file_alone_starts_processes(tmp_path):
    """And none starts a shell; the program itself may start again. The overview names an exception of `subprocess` alone."""
    for path in (ROOT / "warpgs").rglob("*.py"):
        names = ("run", "DEVNULL", "CompletedProcess", "Popen", "PIPE")
        allowed = {"process.py": {f"subprocess.{n}" for n in names} | {"os.execv"}}
        more = {"subprocess.TimeoutExpired"}
        assert set(starters(path)) <= allowed.get(path.name, set()) | more, path
    # the search finds what starts processes
    for text in (
        "import os\nos.system('a')", "from os import popen", "import os as o\no.execvp('a', [])", "from subprocess import run",
        "import subprocess as s\ns.Popen('a')", "f(shell=True)", "import multiprocessing as m\nm.Process()",
        "import concurrent.futures\nconcurrent.futures.ProcessPoolExecutor()",
    ):  # fmt: skip
        (tmp_path / "a.py").write_text(text)
        assert starters(tmp_path / "a.py"), text


# Ctrl-C, SIGTERM and SIGHUP: one sentence and one exit code wherever they come, and none where they are ignored.

SIGNALS = [pytest.param(s, id=n) for n in ("SIGINT", "SIGTERM", "SIGHUP") if (s := getattr(signal, n, None))]
CONTEXTS = [interrupting_signals, noted_signals, ignored_signals]
SENTENCE = "warpgs: interrupted; the fit is saved, --resume continues it\n"
UNSAVED = "warpgs: interrupted; no step was saved: run the same command again\n"


@pytest.fixture
def handlers():
    """The handlers that a program starts with; whatever a test sets, those of pytest are back after it."""
    before = {s.values[0]: signal.getsignal(s.values[0]) for s in SIGNALS}
    for number in before:
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def fit(scene, out, *more):
    flags = ["--steps", "3", "--device", "cpu", "--preset", "3dgs", "--init.source", "random", "--init.random-count", "50"]
    return main(["fit", str(scene), "--split", split_spec(8), "--out", str(out), *flags, *more])


@pytest.mark.usefixtures("handlers")
@pytest.mark.parametrize("context", CONTEXTS)
@pytest.mark.parametrize("number", SIGNALS)
def test_an_ignored_signal_stays_ignored(context, number):
    """As nohup and a shell's `&` leave it: neither noted, nor raised, nor handled in any other way afterwards."""
    signal.signal(number, signal.SIG_IGN)
    with context() as came:
        try:
            signal.raise_signal(number)
        except KeyboardInterrupt:  # which would end pytest
            pytest.fail("the signal was raised")
        assert signal.getsignal(number) is signal.SIG_IGN and (came is None or not came())
    assert signal.getsignal(number) is signal.SIG_IGN


@pytest.mark.usefixtures("handlers")
@pytest.mark.parametrize("context", CONTEXTS)
def test_other_threads_leave_signals_alone(context):
    """Python lets the main thread alone set handlers."""

    def work():
        with context():
            return signal.getsignal(signal.SIGINT)

    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(work).result() == signal.default_int_handler


@pytest.mark.usefixtures("handlers")
@pytest.mark.parametrize("number", SIGNALS)
def test_the_second_signal_is_raised_and_none_is_lost_in_a_destructor(number):
    """Python throws away what a destructor raises: there the first Ctrl-C would do nothing."""
    with noted_signals() as came:
        signal.raise_signal(number)
        assert came()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(number)
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL

    class Thing:
        def __del__(self):
            signal.raise_signal(number)
            raised.append("not in the destructor")

    raised = []
    with pytest.raises(KeyboardInterrupt), interrupting_signals():
        Thing()
        threading.Event().wait(60)  # ended by the signal that comes again
        raised.append("not at all")
    assert raised == []


STAGES = (
    "fit.read_scene",
    "fit.Trainer",
    "fit.background_warmup",
    "fit.write_ply",
    "results.evaluate_run",
    "results.write_page",
)


@pytest.mark.usefixtures("handlers")
@pytest.mark.parametrize(("stage", "number"), [(s, SIGNALS[i % len(SIGNALS)].values[0]) for i, s in enumerate(STAGES)])
def test_outside_the_steps_the_end_is_the_same(demo, tmp_path, capsys, monkeypatch, stage, number):
    """While the scene is read, priors are made, results are scored and written: code 130, and nothing but the sentence."""
    monkeypatch.setattr(f"warpgs.pipeline.run.{stage}", lambda *_, **__: signal.raise_signal(number))
    assert fit(demo, tmp_path / "run") == 130
    early = STAGES.index(stage) < 3
    assert capsys.readouterr().err == (UNSAVED if early else SENTENCE)
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    assert (tmp_path / "run").exists() is not early  # nothing to continue


@pytest.mark.usefixtures("handlers")
@pytest.mark.parametrize("number", SIGNALS)
def test_within_the_steps_the_one_in_progress_is_saved(demo, tmp_path, capsys, monkeypatch, number):
    """And a second signal in the same step ends the fit without it."""
    write, times = EventLog.write, [1]

    def signalled(log, **values):
        write(log, **values)
        for _ in range(times[0]):
            signal.raise_signal(number)

    monkeypatch.setattr(EventLog, "write", signalled)
    assert fit(demo, tmp_path / "run") == 130 and load_checkpoint(tmp_path / "run")[1]["step"] == 1
    times[0] = 2
    assert fit(demo, tmp_path / "run", "--resume") == 130 and load_checkpoint(tmp_path / "run")[1]["step"] == 1
    assert capsys.readouterr().err == 2 * SENTENCE
    monkeypatch.undo()
    assert main(["fit", "--out", str(tmp_path / "run"), "--resume"]) == 0  # all else is as the run was started
    assert "continuing the run: preset 3dgs, 3 steps" in capsys.readouterr().out
    assert load_checkpoint(tmp_path / "run")[1]["step"] == 3


@pytest.mark.usefixtures("handlers")
def test_more_signals_while_the_program_ends(monkeypatch, capsys):
    def tidy(*_):
        try:
            signal.raise_signal(signal.SIGINT)
        finally:
            signal.raise_signal(signal.SIGINT)

    importlib.import_module("warpgs.app.commands")  # a module that is imported later would keep the patched name
    monkeypatch.setattr("warpgs.pipeline.run.export.export", tidy)
    say = process.say
    monkeypatch.setattr(process, "say", lambda *a, **k: (signal.raise_signal(signal.SIGINT), say(*a, **k)))
    try:
        code = main(["export", "run", "--to", "x.ply"])
    except KeyboardInterrupt:  # which would end pytest
        pytest.fail("the command does not end in good order")
    assert code == 130
    assert capsys.readouterr().err == "warpgs: interrupted\n"


# Names of files that are not UTF-8, in every command; and Python that takes names for another encoding.

on_linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="names are text on this system")
BYTES = os.fsdecode(b"b\xe4\xc3\xbc")
"""A name of three letters, the second of which is Latin-1 and the third UTF-8."""
CPU = ["--device", "cpu"]


LEAVING = """
import atexit, sys, threading, time
from warpgs import process
from warpgs.app import cli

class Large:
    def __del__(self):
        print("freed")

def late():
    time.sleep(0.2)
    print("thread")

def run(words):
    threading.Thread(target=late).start()
    sys.stderr.write("no end of line")
    return 3

kept = Large()
atexit.register(print, "at exit")
cli._run = run
sys.exit(cli.main())
"""
"""A program that ends as `warpgs` does."""


@pytest.mark.parametrize(("command", "last"), [("fit", []), ("view", ["freed"])])
def test_a_fit_ends_without_freeing_its_memory(command, last):
    """After all threads and exit functions, with everything printed, and with its code; other commands end as usual."""
    env, words = {n: v for n, v in os.environ.items() if n != "PYTHONUNBUFFERED"}, [command, "scene"]
    done = subprocess.run([sys.executable, "-c", LEAVING, *words], capture_output=True, text=True, check=False, env=env)
    assert done.returncode == 3 and done.stderr == "no end of line"
    assert done.stdout.split("\n")[:-1] == ["thread", "at exit", *last]


TOUCHES = """
import resource, sys, threading
import numpy as np
from warpgs.device import keep_all_freed_memory, keep_freed_memory
if sys.argv[1:]:
    keep_all_freed_memory()
    keep_freed_memory()  # as the first step does
def touch():
    for _ in range(4):
        for size in (10**6, 3 * 10**8):
            np.ones(size, np.uint8)
threads = [threading.Thread(target=touch) for _ in range(2)]
for function in (touch, *(t.start for t in threads), *(t.join for t in threads)):
    function()
faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
touch()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - faults)
"""


@on_linux
def test_kept_memory_is_not_touched_for_the_first_time_again():
    """Arrays of one and of 300 megabytes, after others of their size, by several threads, were freed."""
    faults, kept = (
        int(subprocess.run([sys.executable, "-c", TOUCHES, *words], capture_output=True, check=True).stdout)
        for words in ([], ["kept"])
    )
    assert kept < 20 < faults


@on_linux
def test_names_that_are_no_text_for_output_libraries_and_films(tmp_path, monkeypatch):
    assert readable(f"{BYTES} \ud800") == "b\\xe4ü \\ud800"
    write_text(tmp_path / f"{BYTES}.text", BYTES)
    assert (tmp_path / f"{BYTES}.text").read_text("utf-8") == "b\\xe4ü"
    assert scene_name(f"a/{BYTES}.png", b"\x89PNG\r\n\x1a\n") == "a/b%E4ü.png"
    # a name that a library can take
    folder = tmp_path / BYTES
    folder.mkdir()
    assert utf8_name(tmp_path / "plain") == str(tmp_path / "plain")
    with pytest.raises(UsageError, match=r"b\\xe4ü/file: the name is not UTF-8"):
        utf8_name(folder / "file")
    # OpenCV ended the process at such a name; a film is written and checked, also where temporary files have such a name
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    frames = [np.full((16, 16, 3), 0.2 * i, np.float32) for i in range(3)]
    for suffix in (".mp4", ".webm"):
        path = tmp_path / suffix / BYTES / f"{BYTES}{suffix}"
        path.parent.mkdir(parents=True)
        assert write_film(path, frames) == 3 and [p.name for p in path.parent.iterdir()] == [path.name]


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


@on_linux
def test_a_fit_and_what_follows(scene, tmp_path, capsys):
    run = tmp_path / BYTES
    assert main(["fit", str(scene), "--out", str(run), *flags(2)]) == 0
    record = json.loads((run / "config.json").read_bytes())
    assert record["scene"]["path"] == str(scene) and f"{BYTES}.png" in record["cameras"]
    page = (run / "report.html").read_text("utf-8")
    assert "b\\xe4ü" in page and not any("\ud800" <= c <= "\udfff" for c in page)
    assert all(process.readable(p.name) == p.name for p in (run / "renders").iterdir())
    assert main(["fit", "--out", str(run), "--resume"]) == 0
    assert main(["eval", str(run), *CPU]) == 0
    assert main(["render", str(run), "--frames", "2", "--path", "turntable", *CPU]) == 0
    assert main(["export", str(run), "--to", str(tmp_path / f"{BYTES}.spz")]) == 0
    printed = capsys.readouterr().out
    assert "b\\xe4ü" in printed and BYTES not in printed
    file = tmp_path / f"{BYTES}.py"
    file.write_text("from warpgs.io.colmap import ColmapReader\nclass Own(ColmapReader):\n    pass\n")
    assert main(["fit", str(scene), "--out", str(tmp_path / "run"), "--reader", f"{file}:Own", *flags(1)]) == 0


@on_linux
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


@on_linux
@pytest.mark.slow
def test_the_farm(scene, tmp_path):
    out = tmp_path / BYTES
    assert main(["farm", str(scene.parent), "--out", str(out), *flags(1)]) == 0
    page = (out / "index.html").read_text("utf-8")
    (row,) = csv.DictReader(io.StringIO((out / "results.csv").read_text("utf-8")))
    assert row["name"] == "sceneb\\xe4ü" and row["state"] == "done"
    assert "sceneb%E4%C3%BC/run/report.html" in page and "sceneb%E4%C3%BC/thumbnail.webp" in page
    assert cv2.imdecode(np.fromfile(out / scene.name / "thumbnail.webp", np.uint8), cv2.IMREAD_COLOR) is not None


@on_linux
@pytest.mark.slow
def test_the_other_commands(scene, tmp_path, monkeypatch):
    """Also where the folders of temporary files, of warpgs's cache and the current one have such names."""
    work, run = tmp_path / BYTES, str(tmp_path / BYTES / "run")
    (work / "tmp").mkdir(parents=True)
    monkeypatch.setenv("WARPGS_CACHE", str(work / "cache"))
    monkeypatch.setenv("TMPDIR", str(work / "tmp"))
    monkeypatch.setattr("tempfile.tempdir", None)
    monkeypatch.chdir(work)
    assert main(["fit", str(scene), "--out", run, *flags(30, "quick"), "--init.merge-px", "4"]) == 0  # enough for a surface
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


@on_linux
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


# No file of the product calls what only some systems have, but for those whose tests stand in for the others.

TESTED = {f"warpgs/{n}.py" for n in ("files", "device", "process", "kernels/launch", "locks", "ranks", "folders", "clock")}
FILES = [p for p in sorted((ROOT / "warpgs").rglob("*.py")) if p.relative_to(ROOT).as_posix() not in TESTED]
MODULES = {"fcntl", "grp", "pty", "pwd", "resource", "syslog", "termios", "msvcrt", "winreg"}
NAMES = {
    "os": {"sysconf", "fork", "getuid", "geteuid", "getgid", "getpgid", "setsid", "uname", "getloadavg", "killpg", "statvfs",
           "sched_getaffinity", "sched_setaffinity", "mkfifo", "chown", "nice", "sendfile", "startfile"},
    "signal": {"SIGKILL", "SIGALRM", "SIGHUP", "SIGUSR1", "SIGUSR2", "setitimer", "alarm", "pause"},
}  # fmt: skip
FOLDERS = ("/proc/", "/sys/", "/dev/", "/etc/", "/tmp/")


def found_in(path: Path) -> list[str]:
    found = []
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            found += [a.name for a in node.names if a.name in MODULES]
        elif isinstance(node, ast.ImportFrom):
            found += [node.module] * (node.module in MODULES)
            found += [a.name for a in node.names if a.name in NAMES.get(node.module, ())]
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            found += [ast.unparse(node)] * (node.attr in NAMES.get(node.value.id, ()))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found += [node.value] * node.value.startswith(FOLDERS)
    return found


def test_every_system_has_what_is_called():
    assert not {p.relative_to(ROOT).as_posix(): names for p in FILES if (names := found_in(p))}
