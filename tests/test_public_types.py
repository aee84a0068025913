"""Whoever imports warpgs gets types, and the checker looks at the modules that define public names."""

import importlib
import inspect
import tomllib
from pathlib import Path

import pytest

from tests.test_public_names import FACES, NAMES, seen_by_type_checkers

ROOT = Path(__file__).parent.parent
UNCHECKED = {
    "warpgs.geometry", "warpgs.io.folder", "warpgs.kernels.ssim", "warpgs.kernels.update", "warpgs.mesh.fuse",
    "warpgs.pipeline.model.start", "warpgs.pipeline.model.table", "warpgs.pipeline.train.step", "warpgs.pipeline.train.views",
    "warpgs.pipeline.train.strategies.sampling", "warpgs.render.graphed", "warpgs.ranks", "warpgs.synthetic.demo",
}  # fmt: skip
"""Homes of public names whose bodies mypy does not accept yet: Warp kernels, and fields that are arrays or tensors."""


def test_every_module_of_a_public_name_is_type_checked():
    """Faces and homes of their names are among mypy's files, and the package says that it carries types."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["mypy"]
    homes = {home for face in FACES for home, _ in seen_by_type_checkers(face).values()}
    files = {str(Path(importlib.import_module(m).__file__).relative_to(ROOT)) for m in homes - UNCHECKED | set(FACES)}
    assert settings["strict"] and files <= set(settings["files"])
    assert (ROOT / "warpgs/py.typed").exists()


@pytest.mark.parametrize("name", NAMES)
def test_signatures_of_public_names_are_typed(name):
    """Every argument and result of a function, and of the methods that a class defines; checked homes are not enough."""
    face, _, public = name.rpartition(".")
    value = getattr(FACES[face], public)
    functions = [value] if inspect.isfunction(value) else []
    if inspect.isclass(value):
        functions = [f for f in vars(value).values() if inspect.isfunction(f) and f.__module__ == value.__module__]
    for function in functions:
        if function.__name__[0] != "_" or function.__name__ == "__call__":
            bare = [p.name for p in inspect.signature(function).parameters.values() if p.annotation is p.empty]
            assert set(bare) <= {"self", "cls"} and "return" in function.__annotations__, function
