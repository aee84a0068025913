"""What lies in the current folder never runs: a scene may come from anybody, and may hold a numpy.py."""

import ast
import json
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from warpgs.app.cli import COMMANDS
from warpgs.process import run_python
from warpgs.synthetic.demo import split_spec, write_demo

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


def run(*command: str, path: str = str(ROOT)) -> subprocess.CompletedProcess:
    """Run Python as a user does who has installed warpgs: without any word on safe paths."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONSAFEPATH"} | {"PYTHONPATH": path}
    return subprocess.run(
        [sys.executable, *command], env=environment, capture_output=True, text=True, encoding="utf-8", check=False
    )


@pytest.fixture
def program(tmp_path):
    """The path of the program `warpgs`."""
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "warpgs").write_text(PROGRAM)
    return str(tmp_path / "bin" / "warpgs")


def test_the_trap_works(trap):
    """Plain Python from there runs a planted module."""
    _, mark = trap
    assert subprocess.run([sys.executable, "-c", "import pyvista"], capture_output=True, check=False).returncode == 1
    assert "pyvista.py" in mark.read_text()


FIT = ["--split", split_spec(8), "--steps", "2", "--device", "cpu", "--init.source", "random", "--init.random-count", "50"]
STUDY = ["--split", split_spec(8), "--steps", "2", "--device", "cpu", "--seeds", "1"]


def test_no_fit_runs_what_lies_beside_a_scene(trap, tmp_path):
    """Not even as `python -m`."""
    _, mark = trap
    done = run("-m", "warpgs", "fit", ".", *FIT, "--out", str(tmp_path / "run"))
    assert done.returncode == 0, done.stdout + done.stderr
    assert not mark.exists(), mark.read_text()


def test_the_program_runs_nothing_from_the_current_folder(trap, program):
    """Nor does `python -P -m warpgs`, even where the folder holds what Python itself imports first."""
    folder, mark = trap
    for name in EARLY:
        (folder / f"{name}.py").write_text((folder / "json.py").read_text())
    for command in ([program], ["-P", "-m", "warpgs"]):
        done = run(*command, "demo", f"new{len(command)}", "--views", "8", "--width", "32", "--height", "32")
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
    }  # fmt: skip
    assert {c.split()[0] for c in commands} == {"help", *COMMANDS}
    for name, (code, words) in commands.items():
        done = run(program, *words)
        assert done.returncode == code and not mark.exists(), f"{name}: {done.stdout}{done.stderr}"


def test_a_process_of_ours_starts_in_a_folder_of_its_own(trap):
    """An empty one, on no path of modules, also for what the process starts in turn; it is gone afterwards."""
    _, mark = trap
    code = "import os, sys, subprocess, json; print(json.dumps([os.getcwd(), os.listdir(), sys.argv[1:], os.environ['A']]))\n"
    code += "subprocess.run([sys.executable, '-c', 'import pyvista'], capture_output=True)"
    done = run_python(code, "x y", timeout=100, environment={"A": "é"})
    assert done.returncode == 0, done.stderr
    where, there, arguments, variable = ast.literal_eval(done.stdout)
    assert there == [] and arguments == ["x y"] and variable == "é" and not Path(where).exists()
    assert not mark.exists()


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
    """What a file uses to start processes, however it is imported."""
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


def test_one_file_alone_starts_processes():
    """And none starts a shell; the program itself may start again. The overview names an exception of `subprocess` alone."""
    for path in (ROOT / "warpgs").rglob("*.py"):
        names = ("run", "DEVNULL", "CompletedProcess", "Popen", "PIPE")
        allowed = {"process.py": {f"subprocess.{n}" for n in names} | {"os.execv"}}
        more = {"subprocess.TimeoutExpired"}
        assert set(starters(path)) <= allowed.get(path.name, set()) | more, path


@pytest.mark.parametrize(
    "text",
    [
        "import os\nos.system('a')", "from os import popen", "import os as o\no.execvp('a', [])", "from subprocess import run",
        "import subprocess as s\ns.Popen('a')", "f(shell=True)",
        "import concurrent.futures\nconcurrent.futures.ProcessPoolExecutor()",
        "import multiprocessing as m\nm.Process()",
    ],
)  # fmt: skip
def test_the_search_finds_what_starts_processes(tmp_path, text):
    (tmp_path / "a.py").write_text(text)
    assert starters(tmp_path / "a.py")
