"""The package as `import warpgs` shows it: names, types, documentation of fields, and schemas of what users write."""

import ast
import dataclasses
import importlib
import inspect
import io
import json
import math
import pydoc
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import warpgs
from warpgs import faces, schema
from warpgs.errors import document_fields, field_docs
from warpgs.report.images import png
from warpgs.schema import SchemaError, fields, flag, items, mapping, number, one_of, or_null, parse, real, text, whole
from warpgs.synthetic.demo import camera_path, still_life
from warpgs.synthetic.raycast import Light, render

ROOT = Path(warpgs.__file__).parent
BELOW = ("train", "kernels", "io", "export", "compat.gsplat", "compat.inria")
FACES = {name: importlib.import_module(name) for name in ("warpgs", *(f"warpgs.{n}" for n in BELOW))}
NAMES = [f"{face}.{name}" for face, module in FACES.items() for name in module.__all__]
PAGES = [ROOT.parent / "README.md", ROOT.parent / "CONTRIBUTING.md", *sorted((ROOT.parent / "docs").glob("*.md"))]


def seen_by_type_checkers(face: str) -> dict[str, tuple[str, str]]:
    """Module and name there of each name that a face imports under TYPE_CHECKING, or defines; modules are left out."""
    if face.startswith("warpgs.compat."):
        return {name: (face, name) for name in FACES[face].__all__}
    tree = ast.parse(Path(FACES[face].__file__).read_text("utf-8"))
    (block,) = (n for n in tree.body if isinstance(n, ast.If) and ast.unparse(n.test) == "TYPE_CHECKING")
    found = {a.asname or a.name: (n.module, a.name) for n in block.body if isinstance(n, ast.ImportFrom) for a in n.names}
    return {public: home for public, home in found.items() if home[0] != "warpgs"}


@pytest.mark.parametrize("face", FACES)
def test_dir_lists_the_public_names_and_nothing_else(face):
    """None twice, none that a module would hide; type checkers see the same; the marker of PEP 561 is there."""
    module = FACES[face]
    others = {name for name in BELOW if "." not in name} if module is warpgs else set()
    assert {n for n in dir(module) if not n.startswith("__")} == set(module.__all__) | others
    assert len(set(module.__all__)) == len(module.__all__)
    assert not set(module.__all__) & {p.stem for path in getattr(module, "__path__", []) for p in Path(path).iterdir()}
    with pytest.raises(AttributeError, match=f"module '{face}' has no attribute 'os_path'"):
        module.os_path  # noqa: B018
    assert set(seen_by_type_checkers(face)) == set(FACES[face].__all__)
    assert (ROOT / "py.typed").is_file()


@pytest.mark.parametrize("name", NAMES)
def test_every_public_name_is_there_and_documented(name):
    """It loads from where type checkers find it, with a docstring; every argument and result of it and its methods is typed."""
    face, _, public = name.rpartition(".")
    home, attribute = seen_by_type_checkers(face)[public]
    value = getattr(FACES[face], public)
    assert value is getattr(importlib.import_module(home), attribute) or attribute == "register"  # a method: new at each look
    assert public.isupper() or value.__doc__
    functions = [value] if inspect.isfunction(value) else []
    if inspect.isclass(value):
        functions = [f for f in vars(value).values() if inspect.isfunction(f) and f.__module__ == value.__module__]
    for function in functions:
        if function.__name__[0] != "_" or function.__name__ == "__call__":
            bare = [p.name for p in inspect.signature(function).parameters.values() if p.annotation is p.empty]
            assert set(bare) <= {"self", "cls"} and "return" in function.__annotations__, function


def test_import_loads_neither_torch_nor_warp():
    """A bare import is cheap; the first use of a name pays for it."""
    code = (
        "import sys, warpgs; heavy = {'torch', 'warp', 'numpy', 'cv2', 'tyro'};"
        "warpgs.train, warpgs.kernels, warpgs.io, warpgs.export; print(sorted(heavy & set(sys.modules)));"
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


REFERENCE = (ROOT.parent / "docs/api.md").read_text("utf-8")
LISTED = re.findall(r"^\.\. (?:auto\w+|py:data):: (warpgs[\w.]+)", REFERENCE, re.MULTILINE)


def test_the_reference_lists_every_public_name():
    """A name of several faces at one of them, and every type in the signatures of the base classes."""
    stated = {n.rpartition(".")[2] for n in [*LISTED, *re.findall(r"`(warpgs[\w.]+)", REFERENCE)]}
    assert {n.rpartition(".")[2] for n in NAMES} - stated == set()
    assert set(LISTED) <= set(NAMES)
    own = re.findall(r"^\.\. autoclass:: (warpgs[\w.]+)", REFERENCE.split("## Classes to derive from")[1], re.MULTILINE)
    assert len(own) > 15
    classes = [getattr(importlib.import_module(path.rpartition(".")[0]), path.rpartition(".")[2]) for path in own]
    met = set().union(*map(names_in_annotations, classes))
    assert met - {path.rpartition(".")[2] for path in LISTED} == set()


def named(code: str) -> set[str]:
    """Full names of all that a text of code imports or uses of warpgs, up to the first name that is not a face."""
    tree = ast.walk(ast.parse(code))
    found = set()
    for node in tree:
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "warpgs":
            found |= {f"{node.module}.{a.name}" for a in node.names}
        elif isinstance(node, ast.Import):
            found |= {a.name for a in node.names if a.name.startswith("warpgs.")}
        elif isinstance(node, ast.Attribute) and re.fullmatch(r"warpgs(\.\w+)+", text := ast.unparse(node)):
            found.add(re.match(r"warpgs\.(?:(?:train|kernels|io|export|compat\.gsplat|compat\.inria)\.)?\w+", text)[0])
    return found


def code_of_pages() -> dict[str, str]:
    """Examples, a plug-in of the tests, and the Python blocks of all pages, by place."""
    files = [*sorted((ROOT.parent / "examples").rglob("*.py")), ROOT.parent / "tests/parallel_camera.py"]
    code = {path.name: path.read_text("utf-8") for path in files}
    for page in PAGES:
        for i, block in enumerate(re.findall(r"^```python\n(.*?)^```", page.read_text("utf-8"), re.MULTILINE | re.DOTALL)):
            code[f"{page.name}, block {i}"] = block
    return code


def test_examples_and_pages_import_faces_alone_and_the_package_none():
    """Users copy examples, and what is not on a face may move; in the package names come from where they are defined."""
    code = code_of_pages()
    assert len(code) > 20
    strangers = {place: left for place, text in code.items() if (left := named(text) - set(NAMES) - set(FACES))}
    assert not strangers
    for path in ROOT.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module in FACES and path != ROOT / "__init__.py":
                assert not {a.name for a in node.names} & {*FACES[node.module].__all__, "train"}, f"{path}:{node.lineno}"


OLD = [(f"warpgs.{module}", name, new) for module, names in faces.OLD.items() for name, new in names.items()]


@pytest.mark.parametrize("module,name,new", OLD)
def test_an_old_import_answers(module, name, new):
    """It is the new name, or one of `STILL_THERE`; once it is gone, the error has the new name, which exists."""
    try:
        old = getattr(importlib.import_module(module), name)
    except ImportError as error:
        assert f"{module}.{name} is now {new}" in str(error)
    else:
        place, _, attribute = new.rpartition(".")
        stays = f"{module.removeprefix('warpgs.')}.{name}" in STILL_THERE
        assert stays or old is getattr(importlib.import_module(place), attribute)
    assert new in NAMES or not new.startswith("warpgs.")


STILL_THERE = {
    "report.images.png", "synthetic.demo.camera_path", "synthetic.demo.still_life", "synthetic.raycast.Light",
    "synthetic.raycast.render",
}  # fmt: skip
"""Names outside the faces that are where they were: code that imports them gets the same results as before."""


@pytest.mark.parametrize(
    "light,pixel,mean",
    [
        ((), (0.8626, 0.8271, 0.4869), (0.4856, 0.4660, 0.4470)),
        (((0, -1, 0), 0.5, 0.3, 2.0), (0.5039, 0.4832, 0.2844), (0.2112, 0.2046, 0.1885)),
    ],
)
def test_names_that_stayed_give_what_they_gave(light, pixel, mean):
    camera = camera_path(9, 64, 48)[2]
    assert camera.viewmat[:3, 3] == pytest.approx([0.8011, 0.2279, 0.0505], abs=1e-4)
    image = render(still_life(), Light(*light), camera.K, camera.viewmat, 64, 48, 1)
    assert image[24, 30] == pytest.approx(pixel, abs=1e-3) and image.mean((0, 1)) == pytest.approx(mean, abs=1e-3)
    with Image.open(io.BytesIO(png(image))) as read:
        assert np.array_equal(read, np.round(image * 255).astype(np.uint8))


def test_what_is_gone_names_its_new_place(monkeypatch):
    gone = {name: {"Thing": "warpgs.train.Thing"} for name in ("nowhere.at_all", "version", "version.deep")}
    monkeypatch.setattr(faces, "OLD", gone)
    monkeypatch.delitem(sys.modules, "warpgs.version")
    for name in ("nowhere.at_all", "nowhere", "version.deep"):
        with pytest.raises(ModuleNotFoundError, match=r"Thing is now warpgs\.train\.Thing"):
            importlib.import_module(f"warpgs.{name}")
    with pytest.raises(ImportError, match=r"^warpgs\.version\.Thing is now warpgs\.train\.Thing$"):
        from warpgs.version import Thing  # noqa: F401
    version = importlib.import_module("warpgs.version")
    assert version.__version__ and not hasattr(version, "Other")
    with pytest.raises(ModuleNotFoundError, match=r"No module named 'warpgs\.never_was'"):
        importlib.import_module("warpgs.never_was")
    table = (ROOT.parent / "CHANGELOG.md").read_text("utf-8").split("## New names of old imports")[1]
    rows = []
    for face, modules in (re.match(r"`([\w.]+)`: (.*)", item, re.DOTALL).groups() for item in table.split("\n- ")[1:]):
        for module, names in re.findall(r"`([\w.]+)`\s(.*?)(?:;|$)", modules, re.DOTALL):
            found = re.findall(r"`(\w+)`(?:\s+\(`(\w+)`\))?", names)
            rows += [(module, name, f"{face}.{new or name}") for name, new in found]
    assert sorted(rows) == sorted(OLD)


# Whoever imports warpgs gets types, and the checker looks at the modules that define public names.

UNCHECKED = {
    "warpgs.geometry", "warpgs.io.folder", "warpgs.kernels.ssim", "warpgs.kernels.update", "warpgs.mesh.fuse",
    "warpgs.pipeline.model.start", "warpgs.pipeline.model.table", "warpgs.pipeline.train.step", "warpgs.pipeline.train.views",
    "warpgs.pipeline.train.strategies.sampling", "warpgs.render.graphed", "warpgs.ranks", "warpgs.synthetic.demo",
}  # fmt: skip
"""Homes of public names whose bodies mypy does not accept yet: Warp kernels, and fields that are arrays or tensors."""


def test_every_module_of_a_public_name_is_type_checked():
    """Faces and homes of their names are among mypy's files, and the package says that it carries types."""
    settings = tomllib.loads((ROOT.parent / "pyproject.toml").read_text("utf-8"))["tool"]["mypy"]
    homes = {home for face in FACES for home, _ in seen_by_type_checkers(face).values()}
    modules = (importlib.import_module(m) for m in homes - UNCHECKED | set(FACES))
    files = {str(Path(m.__file__).relative_to(ROOT.parent)) for m in modules}
    assert settings["strict"] and files <= set(settings["files"])


# Schemas: what is allowed passes, anything else is named with its place; size and depth are bounded.


@pytest.mark.parametrize(
    ("kind", "good", "bad"),
    [
        (flag, [True, False], [0, 1, None, "true"]),
        (text, ["", "ä", "\udcff"], [1, None, "a\0b", "\ud800"]),
        (whole(1, 5), [1, 5], [0, 6, True, 1.0, "1", None, 10**4000]),
        (number(0), [0, 0.5, 10**18], [-1, math.nan, math.inf, True, "1", 10**400, None]),
        (number(above=0), [1e-300], [0, -0.0]),
        (real, [math.nan, -math.inf, 3], [True, "3", 10**400]),
        (one_of("a", 1), ["a", 1], ["b", True, 1.0, [], {}]),
        (or_null(flag), [None, True], [0]),
        (items(flag), [[], [True]], [[1], {}, "", None]),
        (items(flag, 2), [[True, False]], [[True], []]),
        (mapping(flag), [{}, {"a": True}], [{"a": 1}, {"a\0": True}, []]),
        (fields({"a": flag}, {"b": flag}), [{"a": True}, {"a": True, "b": False, "c": 1}], [{}, {"a": 1}, {"a": True, "b": 1}]),
        (fields({"a": flag}, others=False), [{"a": True}], [{"a": True, "c": 1}, []]),
    ],
)
def test_what_is_allowed_and_what_is_not(kind, good, bad):
    for value in good:
        kind(value, "x")
    for value in bad:
        with pytest.raises(SchemaError, match="x"):
            kind(value, "x")


@pytest.mark.parametrize("inner", ["[]", "{}", '{"a": []}'])
def test_depth_and_size_are_bounded(inner, monkeypatch):
    """Neither Python's stack nor anybody's who walks through the value is in danger."""

    def nested(depth):
        return "[" * (depth - 1) + inner + "]" * (depth - 1)

    least = parse(nested(schema.MAX_DEPTH - 1))
    assert isinstance(least, list) and json.dumps(least)
    for depth in (schema.MAX_DEPTH + 2, 100_000):
        with pytest.raises(SchemaError, match="nested deeper"):
            parse(nested(depth))
    monkeypatch.setattr(schema, "MAX_BYTES", 10)
    assert parse("[1, 2, 3]") == [1, 2, 3]
    with pytest.raises(SchemaError, match="larger"):
        parse("[1, 2, 3, 4]")


def test_the_place_of_a_wrong_value_is_named_and_only_files_of_json_are_read(tmp_path):
    with pytest.raises(SchemaError, match=r"^a\[1\]\.b must be a finite number, not 'c'$"):
        fields({"a": items(fields({"b": number()}))})({"a": [{"b": 1}, {"b": "c"}]}, "")
    for bad in (b"", b"[", b"\xff\xfe\xfd", b"9" * 5000, b'{"a":}'):
        (tmp_path / "a").write_bytes(bad)
        with pytest.raises(SchemaError, match="not valid JSON"):
            schema.read(tmp_path / "a")
    with pytest.raises(OSError, match="is a folder"):
        schema.read(tmp_path)
    with pytest.raises(FileNotFoundError):
        schema.read(tmp_path / "none")


@pytest.mark.parametrize("text", ["[" + "[]," * 20 + "[]]", b"[" + b"{}," * 20 + b"{}]"])
def test_many_lists_are_refused_before_they_are_made(text, monkeypatch):
    """Two bytes of text become seventy."""
    assert len(schema.parse(text)) == 21
    monkeypatch.setattr(schema, "MAX_PARTS", 20)
    monkeypatch.setattr(schema.json, "loads", lambda text: pytest.fail("it was parsed"))
    with pytest.raises(SchemaError, match="more than 20 lists and objects"):
        schema.parse(text)


# Docstrings of fields are read from source, and `help` shows them.

DOCUMENTED = "ActivatedGaussians Camera CovarianceGaussians Gaussians RasterizeOptions Render Rule Scene View".split()


@pytest.mark.parametrize("name", DOCUMENTED)
def test_help_shows_every_field(name):
    """With the start of its docstring; of options at least 20 letters about each, in lines that fit a terminal."""
    kind = getattr(warpgs, name)
    shown, text = pydoc.plain(pydoc.render_doc(kind)), inspect.getdoc(kind)
    for field in dataclasses.fields(kind):
        assert f"{field.name}: {field_docs(kind)[field.name].split()[0]} " in shown
        assert name not in ("RasterizeOptions", "Rule") or re.search(rf"^    {field.name}: \w.{{20}}", text, re.MULTILINE)
    assert name not in ("RasterizeOptions", "Rule") or max(map(len, text.splitlines())) <= 76  # help adds a margin of 4


@dataclasses.dataclass
class Same:
    """A class whose name is used twice in this file."""

    outer: int
    """Field of the outer class."""

    @dataclasses.dataclass
    class Same:
        """The inner class."""

        inner: int
        """Field of the inner class."""


def test_classes_of_one_name_keep_their_own_fields():
    @dataclasses.dataclass
    class Local(Same):
        """A class of a function."""

        local: int
        """Field of the local class."""

    assert field_docs(Same) == {"outer": "Field of the outer class."}
    assert field_docs(Same.Same) == {"inner": "Field of the inner class."}
    assert field_docs(Local) == {"outer": "Field of the outer class.", "local": "Field of the local class."}
    typed = dataclasses.make_dataclass("Typed", ["x"], namespace={"__doc__": "About."})
    assert field_docs(typed) == {} and document_fields(typed).__doc__.startswith("About.")
