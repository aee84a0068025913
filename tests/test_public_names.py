"""The package as `import warpgs` shows it."""

import ast
import dataclasses
import importlib
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import warpgs

ROOT = Path(warpgs.__file__).parent


def test_dir_lists_the_public_names_and_nothing_else():
    """Beside names with two underscores; sorted as written, none twice."""
    assert {n for n in dir(warpgs) if not n.startswith("__")} == set(warpgs.__all__)
    assert len(set(warpgs.__all__)) == len(warpgs.__all__)
    with pytest.raises(AttributeError, match="no attribute 'os_path'"):
        warpgs.os_path  # noqa: B018


@pytest.mark.parametrize("name", warpgs.__all__)
def test_every_public_name_is_there_and_documented(name):
    """It loads, and its own docstring says what it is."""
    value = getattr(warpgs, name)
    assert value is getattr(importlib.import_module(warpgs._HOMES[name]), name)
    assert name.isupper() or value.__doc__


@pytest.mark.parametrize("kind", [warpgs.RasterizeOptions, warpgs.Rule])
def test_help_describes_every_option(kind):
    """The class documentation has the field's name and at least 20 letters about it, in lines that fit a terminal."""
    text = inspect.getdoc(kind)
    assert max(map(len, text.splitlines())) <= 76  # help adds a margin of 4
    assert len(dataclasses.fields(kind)) >= 8
    assert all(re.search(rf"^    {f.name}: \w.{{20}}", text, re.MULTILINE) for f in dataclasses.fields(kind))


def test_type_checkers_see_the_same_names():
    """The imports under TYPE_CHECKING come from where the names load at run time; the marker of PEP 561 is there."""
    tree = ast.parse((ROOT / "__init__.py").read_text("utf-8"))
    (block,) = (n for n in tree.body if isinstance(n, ast.If) and ast.unparse(n.test) == "TYPE_CHECKING")
    seen = {a.name: n.module for n in block.body if isinstance(n, ast.ImportFrom) for a in n.names}
    assert seen == warpgs._HOMES and set(seen) == set(warpgs.__all__)
    assert (ROOT / "py.typed").is_file()


def test_import_loads_neither_torch_nor_warp():
    """A bare import is cheap; the first use of a name pays for it."""
    code = (
        "import sys, warpgs; heavy = {'torch', 'warp', 'numpy', 'cv2', 'tyro'}; print(sorted(heavy & set(sys.modules)));"
        "dir(warpgs); warpgs.Camera; print('numpy' in sys.modules, 'torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split("\n")[:2] == ["[]", "True False"]


def names_in_annotations(cls: type) -> set[str]:
    """Return the names of warpgs in the annotations of a class: of its fields and of its public methods."""
    module = ast.parse(inspect.getsource(sys.modules[cls.__module__]))
    (body,) = (n for n in module.body if isinstance(n, ast.ClassDef) and n.name == cls.__name__)
    public = [n for n in body.body if not getattr(n, "name", "").startswith("_") or getattr(n, "name", "") == "__call__"]
    annotations = []
    for node in public:
        if isinstance(node, ast.AnnAssign):
            annotations.append(node.annotation)
        elif isinstance(node, ast.FunctionDef):
            annotations += [a.annotation for a in (*node.args.args, *node.args.kwonlyargs) if a.annotation]
            annotations += [node.returns] if node.returns else []
    found = {n.id for annotation in annotations for n in ast.walk(annotation) if isinstance(n, ast.Name)}
    imported = {
        a.name for n in ast.walk(module) if isinstance(n, ast.ImportFrom) and n.module.startswith("warpgs") for a in n.names
    }
    return {n for n in found & (imported | {n.name for n in module.body if isinstance(n, ast.ClassDef)}) if n[0] != "_"}


def test_the_reference_lists_what_a_class_of_ones_own_meets():
    """Every type in the signatures of the base classes, and in those of the types that they lead to."""
    page = (ROOT.parent / "docs" / "api.md").read_text("utf-8")
    listed = re.findall(r"^\.\. (?:autoclass|py:class|py:data):: (warpgs[\w.]+)", page, re.MULTILINE)
    own = re.findall(r"^\.\. autoclass:: (warpgs[\w.]+)", page.split("## Classes to derive from")[1], re.MULTILINE)
    assert len(own) > 15
    classes = [getattr(importlib.import_module(path.rpartition(".")[0]), path.rpartition(".")[2]) for path in own]
    named = set().union(*map(names_in_annotations, classes))
    assert named - {path.rpartition(".")[2] for path in listed} == set()
