"""List of all programs, and a way to start them: `python -m bench NAME ...` is `python -m bench.NAME ...`."""

from __future__ import annotations

import ast
import runpy
import sys
from pathlib import Path

FOLDER = Path(__file__).parent
GROUPS = ("kernels", "fits", "peers")


def programs() -> dict[str, str]:
    """Return all programs by name, each with the first sentence of its docstring."""
    found = {}
    for path in [FOLDER / "document.py", *(p for group in GROUPS for p in sorted((FOLDER / group).glob("*.py")))]:
        tree = ast.parse(path.read_text("utf-8"))
        if any(isinstance(n, ast.FunctionDef) and n.name == "main" for n in tree.body):
            name = ".".join(path.relative_to(FOLDER).with_suffix("").parts)
            found[name] = ast.get_docstring(tree).split("\n", maxsplit=1)[0]
    return found


def main() -> int:
    """Print the list, or run the program named first; return the exit code."""
    name, known = sys.argv[1] if len(sys.argv) > 1 else "--help", programs()
    if name in ("-h", "--help"):
        width = max(map(len, known))
        print(
            "usage: python -m bench NAME [--help] ...", "", *(f"  {n:<{width}}  {what}" for n, what in known.items()), sep="\n"
        )
        return 0
    if name not in known:
        print(f"bench: no program {name!r}; `python -m bench --help` lists them", file=sys.stderr)
        return 2
    del sys.argv[1]
    runpy.run_module(f"bench.{name}", run_name="__main__", alter_sys=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
