"""Counts of the code's shape: long functions, import circles, folders, lines, docstrings; before and after in one table.

usage: python -m bench.shape [--base COMMIT] [--out FILE.json]
Everything is counted by `ast` and git: the files of this checkout as they lie there, and those of COMMIT out of `git archive`.
"""

from __future__ import annotations

import argparse
import ast
import io
import subprocess
import sys
import tarfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

import torch

from bench import result_file

PACKAGE = "warpgs"
FOLDERS = (PACKAGE, "tests", "tools", "bench", "examples", "docs")
SOURCES = (".py", ".cu", ".cpp", ".h", ".sh", ".md")
"""Endings of the files whose lines are counted."""
MAX_LINES, MAX_POSITIONAL = 60, 8
FRAGMENTS = ("What", "How", "Whether", "That", "Those", "Of", "Where", "Which", "Who", "Whose", "Why", "When", "Until")
"""First words of a docstring that make it a clause without a verb of its own."""
NAMED = 20
"""Most offenders that are listed by name."""


def _git(*words: str) -> bytes:
    return subprocess.run(["git", *words], cwd=result_file.ROOT, capture_output=True, check=True).stdout


def _is_source(path: str) -> bool:
    return PurePosixPath(path).suffix in SOURCES and PurePosixPath(path).parts[0] in FOLDERS


def tree_here() -> dict[str, str]:
    """Return the sources of this checkout by path, tracked or not ignored, as they lie there."""
    names = _git("ls-files", "-z", "--cached", "--others", "--exclude-standard").decode().split("\0")
    return {
        n: (result_file.ROOT / n).read_text("utf-8") for n in names if n and _is_source(n) and (result_file.ROOT / n).is_file()
    }


def tree_of(commit: str) -> dict[str, str]:
    """Return the sources of a commit by path.

    Raises:
        CalledProcessError: There is no such commit here.
    """
    with tarfile.open(fileobj=io.BytesIO(_git("archive", "--format=tar", commit))) as archive:
        files = [m for m in archive.getmembers() if m.isfile() and _is_source(m.name)]
        return {m.name: archive.extractfile(m).read().decode("utf-8") for m in files}


def functions(tree: ast.AST) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    """Yield all functions of a module, nested ones too."""
    return (n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef))


def positional(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Return the number of positional arguments, ``self`` and ``cls`` left out."""
    names = [a.arg for a in (*function.args.posonlyargs, *function.args.args)]
    return len(names) - (names[:1] in (["self"], ["cls"]))


def docstrings(tree: ast.Module) -> Iterator[str]:
    """Yield the docstrings of a module, its classes and functions, and the strings below its assignments."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if not isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        for i, line in enumerate(body):
            text = line.value.value if isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant) else None
            after = i == 0 or isinstance(body[i - 1], ast.Assign | ast.AnnAssign)
            if isinstance(text, str) and after:
                yield text


def opens_with_fragment(docstring: str) -> bool:
    """Return whether the first word makes the first sentence a fragment."""
    words = docstring.split()
    return bool(words) and words[0].rstrip(",:;") in FRAGMENTS


def module_name(path: str) -> str:
    """Return the dotted name of a Python file."""
    parts = PurePosixPath(path).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


class _Imports(ast.NodeVisitor):
    """Imports of a module, in functions too, but none that only a type checker sees."""

    def __init__(self, package: str):
        self.package = package
        self.found: list[tuple[str, str | None]] = []

    def visit_If(self, node: ast.If) -> None:
        if ast.unparse(node.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING"):
            for line in node.orelse:
                self.visit(line)
        else:
            self.generic_visit(node)

    def visit_Import(self, node: ast.Import) -> None:
        self.found += [(alias.name, None) for alias in node.names]

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        base = node.module or ""
        if node.level:
            above = self.package.split(".")[: len(self.package.split(".")) - node.level + 1]
            base = ".".join([*above, *([node.module] if node.module else [])])
        self.found += [(base, alias.name) for alias in node.names]


def import_graph(modules: dict[str, tuple[str, ast.Module]]) -> dict[str, set[str]]:
    """Return for each module the modules of the same tree that it imports.

    Args:
        modules: Path and syntax tree by dotted name.
    """
    graph = {}
    for name, (path, tree) in modules.items():
        seen = _Imports(name if path.endswith("__init__.py") else name.rpartition(".")[0])
        seen.visit(tree)
        reached = {f"{base}.{own}" if own and f"{base}.{own}" in modules else base for base, own in seen.found}
        graph[name] = {m for m in reached if m in modules and m != name}
    return graph


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Return the strongly connected components of more than one module, each sorted: two that reach each other share one."""

    def reachable(start: str) -> set[str]:
        seen, todo = set(), [start]
        while todo:
            for following in graph[todo.pop()] - seen:
                seen.add(following)
                todo.append(following)
        return seen

    reach = {m: reachable(m) for m in graph}
    found = {frozenset({m} | {n for n in reach[m] if m in reach[n]}) for m in graph}
    return sorted(sorted(component) for component in found if len(component) > 1)


def measure(sources: dict[str, str]) -> tuple[dict[str, int], dict[str, list[str]]]:
    """Return the counts of a tree by what is counted, and for each the offenders by name."""
    trees = {p: ast.parse(s) for p, s in sources.items() if p.endswith(".py") and p.startswith(f"{PACKAGE}/")}
    folders = Counter(str(PurePosixPath(p).parent) for p in trees)
    largest = max(folders, key=lambda f: folders[f])
    top = [p for p in trees if p.count("/") == 1 and not PurePosixPath(p).name.startswith("__")]
    counts = {"loose files at the top of the package": len(top), "files in the largest folder": folders[largest]}
    names: dict[str, list[str]] = {"loose files at the top of the package": top, "files in the largest folder": [largest]}

    def count(what: str, offenders: list[str]) -> None:
        counts[what], names[what] = len(offenders), offenders

    kernels = f"{PACKAGE}/kernels/"
    for place, inside in (("outside kernels", False), ("in kernels", True)):
        own = [(p, f) for p, tree in trees.items() if p.startswith(kernels) == inside for f in functions(tree)]
        long = [f"{p}:{f.name}" for p, f in own if f.end_lineno - f.lineno + 1 > MAX_LINES]
        count(f"functions over {MAX_LINES} lines, {place}", long)
        wide = [f"{p}:{f.name}" for p, f in own if positional(f) > MAX_POSITIONAL]
        count(f"functions over {MAX_POSITIONAL} positional arguments, {place}", wide)
    found = circles(import_graph({module_name(p): (p, tree) for p, tree in trees.items()}))
    count("import circles", [" ".join(c) for c in found])
    texts = [(p, d) for p, tree in trees.items() for d in docstrings(tree)]
    counts["docstrings"] = len(texts)
    fragments = [f"{p}: {' '.join(d.split())[:60]}" for p, d in texts if opens_with_fragment(d)]
    count("docstrings that open with a fragment", fragments)
    for folder in FOLDERS:
        counts[f"lines of {folder}"] = sum(len(s.splitlines()) for p, s in sources.items() if p.startswith(f"{folder}/"))
    return counts, names


def rows_of(now: dict[str, int], names: dict[str, list[str]], base: dict[str, int] | None) -> list[dict]:
    """Return a row for each count, with the offenders that are left."""
    before = {} if base is None else base
    return [
        {"count": what, **({"base": before[what]} if before else {}), "now": number, "named": names.get(what, [])[:NAMED]}
        for what, number in now.items()
    ]


def table(rows: list[dict]) -> str:
    """Return the rows as a Markdown table."""
    columns = [c for c in ("base", "now") if c in rows[0]]
    head = ["| count | " + " | ".join(columns) + " |", "| --- |" + " ---: |" * len(columns)]
    return "\n".join([*head, *(f"| {r['count']} | " + " | ".join(f"{r[c]:,}" for c in columns) + " |" for r in rows)])


def main(arguments: list[str] | None = None) -> int:
    """Count, print the table, and write it; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--base", help="commit to compare with")
    parser.add_argument("--out", type=Path)
    a = parser.parse_args(arguments)
    try:
        base = measure(tree_of(a.base))[0] if a.base else None
    except subprocess.CalledProcessError as e:
        print(
            f"bench.shape: {a.base} cannot be read: {e.stderr.decode().strip()}; name a commit of this clone", file=sys.stderr
        )
        return 2
    rows = rows_of(*measure(tree_here()), base)
    print(table(rows))
    what = "counts of the code's shape, by ast and git"
    result_file.write(a.out, result_file.result(what, torch.device("cpu"), rows, base=a.base))
    return 0


if __name__ == "__main__":
    sys.exit(main())
