"""What lies in the current folder never runs: a scene may come from anybody, and may hold a numpy.py."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

from warpgs.runtime.subprocesses import run_python
from warpgs.synthetic.demo import split_spec, write_demo

ROOT = Path(__file__).parent.parent.parent
PLANTED = (
    "pyvista", "vtk", "vtkmodules", "numpy", "torch", "PIL", "cv2", "warp", "scipy", "skimage", "rich", "tyro", "psutil",
    "onnxruntime", "safetensors", "matplotlib", "json", "random", "tempfile", "subprocess", "dataclasses", "platform",
    "sitecustomize", "usercustomize",
)  # fmt: skip


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


def run(*arguments: str) -> subprocess.CompletedProcess:
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONSAFEPATH"} | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "warpgs", *arguments]
    return subprocess.run(command, env=environment, capture_output=True, text=True, encoding="utf-8", check=False)


def test_the_trap_works(trap):
    """Plain Python from there runs a planted module."""
    _, mark = trap
    assert subprocess.run([sys.executable, "-c", "import pyvista"], capture_output=True, check=False).returncode == 1
    assert "pyvista.py" in mark.read_text()


@pytest.mark.parametrize("command", ["doctor", "fit"])
def test_no_command_runs_what_lies_beside_a_scene(trap, tmp_path, command):
    """Neither the command itself nor the process that draws the overview; `python -m` would, `warpgs` is the safer case."""
    _, mark = trap
    steps = [".", "--split", split_spec(8), "--steps", "2", "--device", "cpu", "--out", str(tmp_path / "run")]
    done = run("doctor") if command == "doctor" else run("fit", *steps)
    assert done.returncode == 0, done.stdout + done.stderr
    assert not mark.exists(), mark.read_text()


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


def test_no_other_file_starts_processes():
    """And none starts a shell."""
    for path in (ROOT / "warpgs").rglob("*.py"):
        text = path.read_text("utf-8")
        assert "shell=True" not in text and "os.system" not in text
        if path.name != "subprocesses.py":
            used = {ast.unparse(n.func) for n in ast.walk(ast.parse(text)) if isinstance(n, ast.Call)}
            assert not any(u.startswith(("subprocess.", "multiprocessing.", "os.exec", "os.spawn", "os.popen")) for u in used)
