"""List of what can be measured, and a way to start it: `python -m bench NAME ...` is `python -m bench.NAME ...`."""

from __future__ import annotations

import ast
import runpy
import sys
from pathlib import Path

FOLDER = Path(__file__).parent


def programs(folder: Path) -> dict[str, str]:
    """Return the programs of a folder by name, each with the first sentence of its docstring."""
    found = {}
    for path in sorted(folder.glob("*.py")):
        tree = ast.parse(path.read_text("utf-8"))
        if path.stem != "__main__" and any(isinstance(n, ast.FunctionDef) and n.name == "main" for n in tree.body):
            found[path.stem] = ast.get_docstring(tree).split("\n", maxsplit=1)[0]
    return found


def listing() -> str:
    """Return the programs, one line each: the suite first, then the experiments."""
    suite, experiments = programs(FOLDER), programs(FOLDER / "experiments")
    width = max(len(name) for name in [*suite, *(f"experiments.{name}" for name in experiments)])
    lines = ["usage: python -m bench NAME [--help] ...", "", "Rerun for every release:"]
    lines += [f"  {name:<{width}}  {what}" for name, what in suite.items()]
    lines += ["", "Studies of one question each:"]
    lines += [f"  {'experiments.' + name:<{width}}  {what}" for name, what in experiments.items()]
    return "\n".join(lines)


def main() -> int:
    """Print the list, or run the program named first; return the exit code."""
    name = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if name in ("-h", "--help"):
        print(listing())
        return 0
    known = [*programs(FOLDER), *(f"experiments.{n}" for n in programs(FOLDER / "experiments"))]
    if name not in known:
        print(f"bench: {name!r} is no program; `python -m bench --help` lists them", file=sys.stderr)
        return 2
    del sys.argv[1]
    runpy.run_module(f"bench.{name}", run_name="__main__", alter_sys=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
