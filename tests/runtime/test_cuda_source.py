"""CUDA text: it lies in files of one folder, is read by one function, and is part of what is installed."""

import ast
import fnmatch
import tomllib
from pathlib import Path

from warpgs.kernels.native import FOLDER, source

ROOT = Path(__file__).parents[2]
FILES = {p.name for p in (ROOT / "warpgs/kernels/cuda").iterdir()}


def native_bodies():
    """Return file and expression of the CUDA body of each native function of the package."""
    for path in sorted((ROOT / "warpgs").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "wp.func_native":
                yield path.name, node.args[0]


def test_no_cuda_text_stands_in_python():
    """Every body comes from a file, and every file is read by name or included."""
    bodies = list(native_bodies())
    assert len(bodies) >= 20
    assert [f"{file}: {ast.unparse(body)}" for file, body in bodies if not isinstance(body, ast.Call)] == []
    assert {ast.unparse(body.func) for _, body in bodies} == {"source", "_source"}
    named = {body.args[0].value for _, body in bodies if ast.unparse(body.func) == "source"}
    named |= {f"blend_{body.args[0].value}.cu" for _, body in bodies if ast.unparse(body.func) == "_source"}
    text = "".join((FOLDER / name).read_text("utf-8") for name in named)
    assert {name for name in FILES if name in named or f'#include "{name}"' in text} == FILES


def test_names_are_replaced_and_files_included(tmp_path):
    """Whole words alone become numbers, also in a file that is included."""
    (tmp_path / "body.cu").write_text('#include "blend_common.cu"\nint SIDES = SIDE;\n')
    text = source(str(tmp_path / "body.cu"), SIDE=8)
    assert text.startswith("// Declarations") and "WIDE = 8 / 8" in text and text.endswith("int SIDES = 8;\n")
    assert "#include" not in text


def test_a_wheel_holds_all_cuda_text():
    """A wheel takes all files of the package that git does not ignore."""
    wheel = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert wheel == {"packages": ["warpgs"]}
    ignored = [line for line in (ROOT / ".gitignore").read_text("utf-8").splitlines() if line and not line.startswith("#")]
    assert not [n for n in FILES for pattern in ignored if fnmatch.fnmatch(n, pattern.strip("/"))]
