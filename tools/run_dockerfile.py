"""Run the RUN lines of the Dockerfile in a clean folder, without Docker: the lines are tested, but no image is built.

Every path below /opt/warpgs is in that folder instead. COPY copies, ENV and ARG are set; of this machine's environment only
PIP_* and proxies are kept. Lines before USER, which need root, are left out and listed. At the end the entry point is called
with --version, and a demo scene is fitted.

usage: python -m tools.run_dockerfile [cpu|cuda] [--folder FOLDER] [--arg NAME=VALUE ...]
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
HOME = "/opt/warpgs"
"""Folder of all files that the image's own user writes."""
KEPT = re.compile(r"PIP_\w+|\w*_proxy|\w*_PROXY|SSL_CERT_\w+|LANG|LC_\w+")
"""Environment variables of this machine that the lines may see, for access to a package index."""
CHECK = "warpgs --version && warpgs demo $HOME/scenes/a --views 8 --width 48 --height 36 && " + (
    "warpgs farm $HOME/scenes --out $HOME/results --steps 2 --preset quick --device cpu && ls $HOME/results"
)
"""First commands of a user of the image."""


def instructions(text: str) -> list[tuple[str, str]]:
    """Return the instructions of a Dockerfile with their arguments, lines joined and comments left out."""
    lines = [line for line in text.splitlines() if not line.lstrip().startswith("#")]
    joined = "\n".join(lines).replace("\\\n", " ")
    return [
        (word.upper(), rest.strip()) for word, _, rest in (line.partition(" ") for line in joined.splitlines()) if word.strip()
    ]


def of_target(found: list[tuple[str, str]], target: str) -> list[tuple[str, str]]:
    """Return the instructions that make a target: those of the stages that it is built from, then its own."""
    stages: dict[str, list[tuple[str, str]]] = {}
    bases: dict[str, str] = {}
    name = ""
    for word, rest in found:
        if word == "FROM":
            base, _, name = (p.strip() for p in re.split(r"\s(AS)\s", rest, flags=re.IGNORECASE))
            stages[name], bases[name] = [], base
        else:
            stages[name].append((word, rest))
    if target not in stages:
        raise SystemExit(f"the Dockerfile has no target {target}; it has {', '.join(stages)}")
    chain = [target]
    while bases[chain[-1]] in stages:
        chain.append(bases[chain[-1]])
    return [step for stage in reversed(chain) for step in stages[stage]]


def copy(rest: str, folder: Path) -> None:
    """Do a COPY: files into a folder, or the contents of a folder."""
    *sources, target = [word for word in rest.split() if not word.startswith("--")]
    where = Path(target.replace(HOME, str(folder)))
    for source in sources:
        if (ROOT / source).is_dir():
            shutil.copytree(ROOT / source, where, ignore=shutil.ignore_patterns("__pycache__"), dirs_exist_ok=True)
        else:
            where.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / source, where)


def run(steps: list[tuple[str, str]], folder: Path, given: dict[str, str]) -> list[str]:
    """Run the instructions; return the RUN lines that were left out.

    Raises:
        CalledProcessError: A line failed.
    """
    environment = {k: v for k, v in os.environ.items() if KEPT.fullmatch(k)}
    environment |= {"PATH": os.environ["PATH"], "HOME": str(folder)}
    left_out, root = [], True
    for word, rest in [*steps, ("RUN", CHECK)]:
        rest = rest.replace(HOME, str(folder))
        if word == "USER":
            root = False
        elif word == "ARG":
            name, _, value = rest.partition("=")
            environment[name] = given.get(name, value)
        elif word == "ENV":
            for pair in shlex.split(rest):
                name, _, value = pair.partition("=")
                environment[name] = value.replace("$PATH", environment["PATH"])
        elif word == "COPY":
            copy(rest, folder)
        elif word == "RUN" and root:
            left_out.append(rest)
        elif word == "RUN":
            print(f"RUN {rest}", flush=True)
            subprocess.run(["sh", "-c", rest], env=environment, cwd=folder, check=True)
    return left_out


def main(arguments: list[str] | None = None) -> int:
    """Run a target; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("target", nargs="?", default="cpu")
    parser.add_argument("--folder", type=Path, help="an empty folder; default: a temporary folder")
    parser.add_argument("--arg", action="append", default=[], help="as docker build --build-arg")
    a = parser.parse_args(arguments)
    steps = of_target(instructions((ROOT / "Dockerfile").read_text("utf-8")), a.target)
    with tempfile.TemporaryDirectory() as temporary:
        folder = (a.folder or Path(temporary) / "warpgs").resolve()
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise SystemExit(f"{folder} is not empty; give a clean one")
        try:
            left_out = run(steps, folder, dict(pair.split("=", 1) for pair in a.arg))
        except subprocess.CalledProcessError as e:
            print(f"failed with exit code {e.returncode}", file=sys.stderr)
            return 1
    print(*(f"not run, because it needs root: {' '.join(line.split())}" for line in left_out), sep="\n")
    print(f"target {a.target}: all other RUN lines work in a clean folder; the image itself was not built")
    return 0


if __name__ == "__main__":
    sys.exit(main())
