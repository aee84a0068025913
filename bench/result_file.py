"""The one format of all results: what was measured, with which command and code, on what, and a row for each measurement."""

from __future__ import annotations

import json
import shlex
import sys
from pathlib import Path

import torch

from bench.machine import describe
from warpgs.files import write_json

ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / "bench/results"
"""The latest result of each measurement, named ``KIND_MACHINE.json``; the commit stands inside."""
KEYS = ("what", "command", "commit", "date", "machine", "versions", "rows")
"""Keys that every result holds, in this order; ``commit`` and ``date`` are None where nobody kept them."""


def command_line() -> str:
    """Return the command that runs this program, without folders of this machine."""
    main = sys.modules["__main__"]
    spec = getattr(main, "__spec__", None)
    name = spec.name.removesuffix(".__main__") if spec else Path(sys.argv[0]).name
    words = [Path(word).name if Path(word).is_absolute() else word for word in sys.argv[1:]]
    return shlex.join(["python", "-m", name, *words])


def result(what: str, device: torch.device, rows: list[dict], **facts) -> dict:
    """Return a result of this program on this machine.

    Args:
        what: One sentence that says what a row measures.
        device: Where it was measured.
        rows: Plain values, a dictionary for each measurement.
        **facts: What else a reader or a later run needs.
    """
    machine = describe(device)
    commit, date, versions = (machine.pop(name) for name in ("commit", "date", "versions"))
    head = {"what": what, "command": command_line(), "commit": commit, "date": date, "machine": machine, "versions": versions}
    return head | facts | {"rows": rows}


def write(path: Path | None, values: dict) -> None:
    """Write a result; nothing where no path is given.

    Raises:
        ValueError: The result lacks a key of the format.
    """
    missing = [k for k in KEYS if k not in values]
    if missing:
        raise ValueError(f"{path}: the result has no {', '.join(missing)}; make it with bench.result_file.result")
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, values)


def read(path: Path) -> dict:
    """Return a stored result.

    Raises:
        ValueError: The file is of another format.
    """
    values = json.loads(path.read_text("utf-8"))
    missing = [k for k in KEYS if not isinstance(values, dict) or k not in values]
    if missing:
        raise ValueError(f"{path}: no result, it has no {', '.join(missing)}; measure again or choose another file")
    return values


def stored(kind: str) -> dict[str, dict]:
    """Return the kept results of a kind by machine, as ``h200`` of ``ops_h200.json``."""
    return {p.stem.removeprefix(f"{kind}_"): read(p) for p in sorted(FOLDER.glob(f"{kind}_*.json"))}
