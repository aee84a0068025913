"""The house rules that a machine can check."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parent.parent
PRODUCT = sorted((ROOT / "warpgs").rglob("*.py"))
BENCH = ROOT / "bench"
BENCHES = sorted(p for name in ("kernels", "fits", "peers") for p in (BENCH / name).glob("*.py"))


def test_files_are_rooms():
    """At most 800 lines, a name that says what is made, and a module docstring."""
    for path in PRODUCT:
        text = path.read_text("utf-8")
        assert len(text.splitlines()) <= 800, path
        assert path.stem not in ("utils", "helpers", "common", "misc", "manager"), path
        assert ast.get_docstring(ast.parse(text)), path


LAUNCHES = ("launch.py", "graphs.py")
"""Files that launch the kernels of all rooms."""
PARTS = {
    "check_round_trip", "composite_gradients", "instance_weights", "project_gradients", "project_inputs", "project_tensors",
    "update_rows",
}  # fmt: skip
"""Functions of kernel rooms that launch, but are compared as a part of the op that calls them."""


def test_an_op_is_compared_with_a_dense_reference():
    """Every function of a kernel room that launches is named by a test that imports from `tests/reference`."""
    tests = [p.read_text("utf-8") for p in (ROOT / "tests").rglob("test_*.py")]
    named = {word for text in tests if re.search(r"^from tests\.reference", text, re.M) for word in re.findall(r"\w+", text)}
    ops = {f.name for p in (ROOT / "warpgs/kernels").glob("*.py") for f in ast.parse(p.read_text("utf-8")).body if launches(f)}
    ops -= {
        f.name for name in LAUNCHES for f in ast.parse((ROOT / "warpgs/kernels" / name).read_text("utf-8")).body if launches(f)
    }
    assert len(ops) > 20 and ops - named == PARTS


def launches(node: ast.stmt) -> bool:
    """Whether a statement defines a public function that launches a kernel, or calls an autograd function that does."""
    called = [ast.unparse(n.func).rpartition(".")[2] for n in ast.walk(node) if isinstance(n, ast.Call)]
    return isinstance(node, ast.FunctionDef) and node.name[0] != "_" and bool({"launch", "apply", "_walk"} & set(called))


def nodes_of(path: Path) -> list[ast.AST]:
    """All nodes of a file."""
    return list(ast.walk(ast.parse(path.read_text("utf-8"))))


def imports(nodes: list[ast.AST]) -> set[str]:
    """Top-level names of everything that a file imports."""
    found = {a.name for n in nodes if isinstance(n, ast.Import) for a in n.names}
    found |= {n.module for n in nodes if isinstance(n, ast.ImportFrom) and n.module}
    return {name.split(".")[0] for name in found}


PICKLING = {"pickle", "_pickle", "cloudpickle", "dill", "joblib", "shelve", "marshal", "submitit", "multiprocessing"}
"""Modules that load or send pickles."""
RUNNING = {"torch.save", "pickle.load", "pickle.loads", "eval", "exec", "np.save"}
"""Functions that run or write what could be run."""
SAFE = {"np.load": ("allow_pickle", False), "torch.load": ("weights_only", True)}
"""Functions that could run what they read, and the argument that forbids it."""


def test_nothing_can_run_foreign_code():
    """No pickle, no eval, no exec; files are read without objects; farm/ray.py alone imports Ray, which sends pickles."""
    for path in PRODUCT:
        nodes = nodes_of(path)
        imported = imports(nodes)
        assert not imported & PICKLING, path
        assert "ray" not in imported or path == ROOT / "warpgs/pipeline/farm/ray.py", path
        for node in nodes:
            if isinstance(node, ast.Call) and isinstance(node.func, (ast.Name, ast.Attribute)):
                called = ast.unparse(node.func)
                assert called not in RUNNING, f"{path}:{node.lineno}"
                flag, value = SAFE.get(called, ("", None))
                assert not flag or any(k.arg == flag and k.value.value is value for k in node.keywords), f"{path}:{node.lineno}"


def test_readers_know_no_torch():
    """A scene is numpy; torch begins in the pipeline."""
    for path in (p for p in PRODUCT if p.parent.name == "io"):
        assert not imports(nodes_of(path)) & {"torch", "warp"}, path


def bench_imports(path: Path) -> set[str]:
    """Modules of the benches that a file imports, as `bench.lib.timing`."""
    found = set()
    for node in nodes_of(path):
        if isinstance(node, ast.Import):
            found |= {a.name for a in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {f"{node.module}.{a.name}" for a in node.names}
    return {name for name in found if name.split(".")[0] == "bench"}


def test_benches_share_only_what_stands_in_lib_and_are_listed():
    """Programs are free to change: none imports another, tests import their list alone; a README has a row for each."""
    for path in [*BENCHES, *(BENCH / "lib").glob("*.py")]:
        assert all(name.startswith("bench.lib") for name in bench_imports(path)), path
        assert len(path.read_text("utf-8").splitlines()) <= 800, path
    naming = [p for p in (ROOT / "tests").rglob("*.py") if "bench" in p.read_text("utf-8")]
    found = {name for p in naming for name in bench_imports(p)}
    assert {n for n in found if not n.startswith("bench.lib")} <= {"bench.__main__"}
    text = (BENCH / "README.md").read_text("utf-8")
    for path in BENCHES:
        if any(isinstance(n, ast.FunctionDef) and n.name == "main" for n in ast.parse(path.read_text("utf-8")).body):
            assert f"| `{path.parent.name}.{path.stem}` |" in text, path
