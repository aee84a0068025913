"""Command lines of the programs: positional arguments, and flags by their defaults, with the same help for the same flag."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

WORDS = {
    "arms": "methods to compare: the first so many of the set, or their names where the default is a list",
    "data": "folder of the scenes (docs/reproduce.md)",
    "device": "cpu, cuda or auto",
    "downscale": "factor by which both sides of images shrink",
    "first_seed": "so that several processes can share the work",
    "folds": "most fits that leave training views out, for each number of steps; fewer are faster and less certain",
    "jobs": "fits at a time; times are meaningful only with 1",
    "only": "a configuration's name, or its beginning",
    "out": "JSON file to write; many programs keep its finished rows",
    "presets": "presets, also with settings: default:steps=500,optimizer.scales_lr=0.1",
    "programs": "names of the programs to run; default: all",
    "rows": "named rows, or FOLDER@SPLIT@DOWNSCALE",
    "seconds": "time after which no further fit begins [s]",
    "seeds": "number of seeds, or the seeds themselves where the default is a list",
    "set": "comparison: rivals, papers, dtu, ladder or ablation (bench/lib/arms.py)",
    "shrink": "factor by which both sides of images shrink further, to try the program",
    "split": "as in `warpgs fit --split`",
    "threads": "CPU threads; 0 for as many as there are",
    "work": "folder for scenes and fits; default: a temporary folder",
}
"""Help of flags that several programs have."""


class _Help(argparse.RawDescriptionHelpFormatter, argparse.ArgumentDefaultsHelpFormatter):
    """Show the docstring unchanged, and the default of each flag."""


def parse(
    doc: str, given: list[str] | None = None, places: dict | None = None, need: tuple[str, ...] = (), **flags
) -> argparse.Namespace:
    """Parse a command line."""
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    program = f"python -m {spec.name}" if spec else None
    parser = argparse.ArgumentParser(program, description=doc, formatter_class=_Help)
    for name, kind in (places or {}).items():
        many: dict = {"nargs": "+"} if isinstance(kind, list) else {"nargs": "?"} if name.endswith("?") else {}
        kind = kind[0] if isinstance(kind, list) else kind
        many["help"] = WORDS.get(name.rstrip("?"))
        parser.add_argument(name.rstrip("?"), **({"choices": kind} if isinstance(kind, tuple) else {"type": kind}), **many)
    for name, default in flags.items():
        how: dict = {"help": WORDS.get(name, " "), "dest": name, "required": name in need}
        if default is False:
            how["action"] = "store_true"
        elif isinstance(default, list):
            several = [] if isinstance(default[0], type) else default
            how |= {"nargs": "+", "default": several, "type": default[0] if not several else type(default[0])}
        elif isinstance(default, type):
            how["type"] = default
        else:
            how |= {"default": default, "type": type(default)}
        parser.add_argument(f"--{name.replace('_', '-')}", **how)
    return parser.parse_args(given)


SCENE = {"scene": Path}
"""Positional argument of most programs: one scene folder."""
