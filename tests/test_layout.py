"""The house rules that a machine can check."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PRODUCT = sorted((ROOT / "warpgs").rglob("*.py"))
BENCH = ROOT / "bench"
BENCHES = sorted(p for name in ("kernels", "fits", "peers", "studies") for p in (BENCH / name).glob("*.py"))
SHARED = {
    "__init__", "functions", "native", "compiler", "falloff",
    "project_backward", "project_inputs", "ssim_cpu", "ssim_cuda", "blend_cpu", "blend_cpu_backward",
    "blend_cuda", "blend_records", "blend_settings", "scanlines_cpu", "sh",
}  # fmt: skip


@pytest.mark.parametrize("op", sorted({p.stem for p in (ROOT / "warpgs/kernels").glob("*.py")} - SHARED))
def test_an_op_has_one_name_in_four_places(op):
    """Kernel, reference, test and bench."""
    for room in (f"tests/reference/{op}.py", f"tests/kernels/test_{op}.py", f"bench/kernels/bench_{op}.py"):
        assert (ROOT / room).is_file(), room


@pytest.mark.parametrize("path", PRODUCT, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_files_are_rooms(path):
    """At most 400 lines, a name that says what is made, and a module docstring."""
    text = path.read_text("utf-8")
    assert len(text.splitlines()) <= 400
    assert path.stem not in ("utils", "helpers", "common", "misc", "manager")
    assert ast.get_docstring(ast.parse(text))


def calls(path: Path) -> set[str]:
    """Dotted names of everything that a file calls."""
    return {ast.unparse(node.func) for node in ast.walk(ast.parse(path.read_text("utf-8"))) if isinstance(node, ast.Call)}


def imports(path: Path) -> set[str]:
    """Top-level names of everything that a file imports."""
    tree = list(ast.walk(ast.parse(path.read_text("utf-8"))))
    found = {a.name for n in tree if isinstance(n, ast.Import) for a in n.names}
    found |= {n.module for n in tree if isinstance(n, ast.ImportFrom) and n.module}
    return {name.split(".")[0] for name in found}


PICKLING = {"pickle", "_pickle", "cloudpickle", "dill", "joblib", "shelve", "marshal", "submitit", "multiprocessing"}
"""Modules that load or send pickles."""


@pytest.mark.parametrize("path", PRODUCT, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_nothing_can_run_foreign_code(path):
    """No pickle, no eval, no exec; numpy files are read without objects, foreign torch files as tensors only.

    Ray sends pickles: farm/ray.py alone imports it, when it is asked for.
    """
    imported = imports(path)
    assert not imported & PICKLING and ("ray" not in imported or path == ROOT / "warpgs/pipeline/farm/ray.py")
    used = calls(path)
    assert not used & {"torch.save", "pickle.load", "pickle.loads", "eval", "exec", "np.save"}
    safe = {"np.load": ("allow_pickle", False), "torch.load": ("weights_only", True)}
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Call) and ast.unparse(node.func) in safe:
            flag, value = safe[ast.unparse(node.func)]
            assert any(k.arg == flag and k.value.value is value for k in node.keywords)


@pytest.mark.parametrize("path", [p for p in PRODUCT if p.parent.name == "io"], ids=lambda p: p.name)
def test_readers_know_no_torch(path):
    """A scene is numpy; torch begins in the pipeline."""
    assert not imports(path) & {"torch", "warp"}


def bench_imports(path: Path) -> set[str]:
    """Modules of the benches that a file imports, as `bench.lib.timing`."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            found |= {a.name for a in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {f"{node.module}.{a.name}" for a in node.names}
    return {name for name in found if name.split(".")[0] == "bench"}


@pytest.mark.parametrize("path", BENCHES + sorted((BENCH / "lib").glob("*.py")), ids=lambda p: p.relative_to(BENCH).as_posix())
def test_benches_share_only_what_stands_in_lib(path):
    """A program imports no other program; what two of them share stands in `bench/lib`. Files are short as elsewhere."""
    assert all(name.startswith("bench.lib") for name in bench_imports(path))
    assert len(path.read_text("utf-8").splitlines()) <= 400


def test_tests_import_only_the_lib_of_the_benches():
    """Programs are free to change; `bench.__main__`, the list of them, is an exception."""
    found = {name for p in (ROOT / "tests").rglob("*.py") for name in bench_imports(p)}
    assert {n for n in found if not n.startswith("bench.lib")} <= {"bench.__main__"}


def test_the_readme_of_the_benches_lists_every_program():
    """A row for each file with a `main`, with its command."""
    text = (BENCH / "README.md").read_text("utf-8")
    for path in BENCHES:
        if any(isinstance(n, ast.FunctionDef) and n.name == "main" for n in ast.parse(path.read_text("utf-8")).body):
            assert f"| `{path.parent.name}.{path.stem}` |" in text, path
