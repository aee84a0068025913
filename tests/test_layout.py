"""The house rules that a machine can check."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PRODUCT = sorted((ROOT / "warpgs").rglob("*.py"))
SHARED = {
    "__init__", "functions", "native", "compiler", "falloff",
    "project_backward", "project_inputs", "ssim_cpu", "ssim_cuda", "blend_cpu", "blend_cpu_backward",
    "blend_cuda", "blend_settings", "scanlines_cpu", "sh",
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


@pytest.mark.parametrize("path", PRODUCT, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_nothing_can_run_foreign_code(path):
    """No pickle, no eval, no exec; numpy files are read without objects, foreign torch files as tensors only."""
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
    imported = {a.name for n in ast.walk(ast.parse(path.read_text("utf-8"))) if isinstance(n, ast.Import) for a in n.names}
    imported |= {n.module for n in ast.walk(ast.parse(path.read_text("utf-8"))) if isinstance(n, ast.ImportFrom) and n.module}
    assert not any(name.split(".")[0] in ("torch", "warp") for name in imported)
