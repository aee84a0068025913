"""The format of all results: description, command, commit, machine, and a row for each measurement."""

from __future__ import annotations

import json
import os
import platform
import re
import shlex
import subprocess
import sys
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch
import warp

from warpgs.device import installed_bytes, processor_name
from warpgs.files import write_json

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "bench/results"
"""Folder with the latest result of each measurement, named ``KIND_MACHINE.json``; the file contains the commit."""
KEYS = ("what", "command", "commit", "date", "machine", "versions", "rows")
"""Keys of every result, in this order; ``commit`` and ``date`` are None if they were not recorded."""


def commit_of(checkout: Path = ROOT) -> str | None:
    """Return the commit of a checkout, with a mark if files have been changed; None outside a repository."""
    command = ["git", "describe", "--always", "--abbrev=12", "--dirty", "--exclude=*"]
    try:
        done = subprocess.run(command, cwd=checkout, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() or None


def _versions(device: torch.device) -> dict[str, str]:
    versions = {"python": platform.python_version(), "torch": torch.__version__, "warp": warp.config.version}
    for name in ("gsplat", "gswarp"):
        found = getattr(
            sys.modules.get(name), "__version__", None
        )  # of a program that lies on the path without being installed
        try:
            versions[name] = found or version(name)
        except PackageNotFoundError:
            pass
    return versions | ({"cuda": torch.version.cuda} if device.type == "cuda" else {})


def _machine(device: torch.device) -> dict:
    cuda = device.type == "cuda"
    record = {
        "device": device.type,
        "name": torch.cuda.get_device_name(device) if cuda else processor_name(),
        "processor": processor_name(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "omp_wait_policy": os.environ.get("OMP_WAIT_POLICY"),
        "memory_gib": round(installed_bytes(torch.device("cpu")) / 2**30, 1),
    }
    if cuda:
        record["device_memory_gib"] = round(torch.cuda.get_device_properties(device).total_memory / 2**30, 1)
    return record


def command_line() -> str:
    """Return the command that runs this program, without folders of this machine."""
    main = sys.modules["__main__"]
    spec = getattr(main, "__spec__", None)
    name = spec.name.removesuffix(".__main__") if spec else Path(sys.argv[0]).name
    words = [Path(word).name if Path(word).is_absolute() else word for word in sys.argv[1:]]
    return shlex.join(["python", "-m", name, *words])


def result(what: str, device: torch.device, rows: list[dict], **facts) -> dict:
    """Return a result of this program on this machine."""
    head = {"what": what, "command": command_line(), "commit": commit_of(), "date": datetime.now(UTC).strftime("%Y-%m-%d")}
    return head | {"machine": _machine(device), "versions": _versions(device)} | facts | {"rows": rows}


def keep(path: Path | None, what: str, device: torch.device, rows: list[dict], **facts) -> None:
    """Write a result of this program on this machine; nothing if no path is given."""
    write(path, result(what, device, rows, **facts))


def write(path: Path | None, values: dict) -> None:
    """Write a result; nothing if no path is given."""
    missing = [k for k in KEYS if k not in values]
    if missing:
        raise ValueError(f"{path}: the result has no {', '.join(missing)}; make it with bench.lib.result_file.result")
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, values)


def read(path: Path) -> dict:
    """Return a stored result."""
    values = json.loads(path.read_text("utf-8"))
    missing = [k for k in KEYS if not isinstance(values, dict) or k not in values]
    if missing:
        raise ValueError(f"{path}: no result, it has no {', '.join(missing)}; measure again or choose another file")
    return values


def machine_name(values: dict) -> str:
    """Return the machine of a result as the pages name it: ``2 cores``, ``H200``."""
    return "2 cores" if values["machine"]["device"] == "cpu" else values["machine"]["name"].removeprefix("NVIDIA ")


def source(name: str) -> str:
    """Return a line on a kept result for the pages: file, machine, commit, command without its output, cut if it is long."""
    values = read(FOLDER / f"{name}.json")
    machine = machine_name(values)
    if values["machine"]["device"] == "cpu":
        machine += ", " + values["machine"]["name"].replace("(R)", "").removesuffix(" Processor")
    command = re.sub(r" --out [\w./]+", "", values["command"] or "")
    command = re.sub(r"^python -m (\S+)( \S+){7,}$", r"\1", command)
    fence = "``" if "`" in command else "`"
    ran = f"{fence}{command}{fence}" if command else "command not kept"
    commit = values.get("commits", {}).get("new") or values["commit"] or "not kept"
    return f"Source: `{name}.json`; {machine}; commit {commit}; {ran}.\n"


def stored(kind: str) -> dict[str, dict]:
    """Return the kept results of a kind by machine, as ``h200`` of ``ops_h200.json``."""
    return {p.stem.removeprefix(f"{kind}_"): read(p) for p in sorted(FOLDER.glob(f"{kind}_*.json"))}
