"""Counts of the code's shape on small trees whose counts are known."""

import ast

import pytest

from bench import shape

LONG = "def long(a, b, c, d, e, f, g, h, i, *, k=0):\n" + "    a += 1\n" * 60


def counted(**files: str) -> dict[str, int]:
    """Counts of a tree; ``__`` stands for a slash."""
    return shape.measure({f"{name.replace('__', '/')}.py": text for name, text in files.items()})[0]


def test_what_is_counted():
    """Files, functions of more than 60 lines, more than 8 positional arguments without self, lines by folder."""
    method = 'class A:\n    def eight(self, a, b, c, d, e, f, g, h):\n        """What it is."""\n'
    counts = counted(warpgs__a=LONG, warpgs__b="x = 1\n", warpgs__kernels__k=LONG + method, tests__t="a\nb\n")
    assert counts["loose files at the top of the package"] == counts["files in the largest folder"] == 2
    for what in ("functions over 60 lines", "functions over 8 positional arguments"):
        assert counts[f"{what}, outside kernels"] == counts[f"{what}, in kernels"] == 1
    assert counts["lines of tests"] == 2 and counts["lines of warpgs"] == 61 + 1 + 64
    assert counts["docstrings that open with a fragment"] == counts["docstrings"] == 1
    assert counted(warpgs__a=LONG.replace("    a += 1\n", "", 1))["functions over 60 lines, outside kernels"] == 0


@pytest.mark.parametrize(("text", "fragment"), [("Of a view.", True), ("Whatever: x.", False), ("Return it.", False)])
def test_fragments(text, fragment):
    """The first word decides, and only a whole word."""
    assert shape.opens_with_fragment(text) == fragment


def test_docstrings_are_those_of_code_and_of_assignments():
    """Strings anywhere else are none."""
    tree = ast.parse(
        '"""M."""\nx = 1\n"""X."""\ndef f():\n    """F."""\n    g()\n    """No."""\nclass C:\n    y: int\n    """Y."""\n'
    )
    assert sorted(shape.docstrings(tree)) == ["F.", "M.", "X.", "Y."]


def test_import_circles():
    """Two modules that reach each other by any import are one circle; what a type checker sees alone is none."""
    back = "if TYPE_CHECKING:\n    from warpgs import a\nelse:\n    pass\n"
    tree = {"warpgs__a": "from warpgs.b import x\n", "warpgs__b": "def f():\n    from warpgs.s import c\n"}
    assert counted(**tree, warpgs__s__c="from .. import a\n")["import circles"] == 1
    assert counted(**tree, warpgs__s__c=back)["import circles"] == 0
    apart = counted(**tree, warpgs__s__c=back, warpgs__d="from warpgs import e\n", warpgs__e="import warpgs.d\n")
    assert apart["import circles"] == 1


def test_a_commit_is_read_out_of_git_and_compared():
    """Sources alone, all of them; the table has a row a count and a column a tree."""
    tree = shape.tree_of("HEAD")
    assert {"warpgs/scene.py", "docs/blend.md", "tests/conftest.py"} <= set(tree) and "pyproject.toml" not in tree
    counts, names = shape.measure({"warpgs/scene.py": tree["warpgs/scene.py"]})
    text = shape.table(shape.rows_of(counts, names, counts))
    assert text.splitlines()[0] == "| count | base | now |" and len(text.splitlines()) == 2 + len(counts)
    assert shape.main(["--base", "no-such-commit"]) == 2
