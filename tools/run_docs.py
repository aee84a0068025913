"""Run the commands and the Python snippets of the README and of all pages, as a reader would type them (`make docs-run`).

Each page has its own temporary folder, in which its blocks run one after the other. Files that a page uses but does not make
are put there first (`INPUTS`). A program `warpgs`, first on the path, shortens commands (`LIMITS`), and ends the viewer once it
prints its address.

A block that cannot run is below a comment with the reason, `<!-- docs-run: REASON -->`. Single lines with a prefix in
`LEFT_OUT` are left out, too. All left-out lines are printed at the end with their reasons.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
INSTALL = "docs/install.md"
FENCE = re.compile(r"(?:<!-- docs-run: (?P<reason>[^\n]*?) -->\s*\n)?^```(?P<kind>[^\n`]*)\n(?P<code>.*?)^```", re.S | re.M)
SHELLS = {"bash", "sh", "shell", "console"}
PROGRAMS = ("warpgs ", "pip ", "ssh ", "make ", "python ", "git ")
"""First words that mark a block without a language as one for a shell."""
LEFT_OUT = (
    (r"ssh ", "another machine"),
    (r"warpgs .*--device cuda\b", "GPU"),
    (r"torchrun ", "several GPUs"),
    (r"make (demo|test|install)\b", "the workflow test runs it"),
    (r"(python3 -m venv|source .*activate|pip install '?(\.|torch)|git clone)", "installing, which --install runs"),
)
"""Patterns of lines that are left out, with reasons."""
INPUTS = ("scene", "photographs", "PHOTOGRAPHS", "run", "scenes", "keyframes.json", "examples")
"""What pages may use: the small demo scene; its images alone; a short fit; a folder of scenes; cameras of a film; examples."""
MAKE_INPUTS = """
warpgs demo scene --views 8 && mkdir scenes && cp -r scene scenes/demo
python -c "from warpgs.synthetic.demo import write_demo; write_demo('large', views=8, width=160, height=120)"
for name in photographs PHOTOGRAPHS; do cp -r large/images $name; done
warpgs fit scene --out run --split every:4
python - <<'END'
import json, numpy, warpgs
cameras = warpgs.open_run("run").cameras(units="file").values()
keys = [{"c2w": numpy.linalg.inv(c.viewmat).tolist(), "fov_y": 0.8, "seconds": float(i)} for i, c in enumerate(cameras)]
open("keyframes.json", "w").write(json.dumps(keys))
END
"""
LIMITS = {
    "demo": {"--width": "96", "--height": "72"}, "fit": {"--steps": "40"}, "farm": {"--steps": "40"},
    "render": {"--frames": "4"}, "compare": {"--steps": "20", "--seeds": "1", "--downscale": "1"}, "view": {"--port": "0"},
    "ablate": {"--steps": "20", "--seeds": "1", "--downscale": "1"},
}  # fmt: skip
"""Largest values of flags by command; a flag is set to its value if a page gives no value or a larger one."""
TIME, VIEWER_TIME = 900, 300
"""Time limits of a block, and of the viewer to print its address, or to end [s]; on a busy machine it finishes an image."""


@dataclass(frozen=True)
class Block:
    """A block of a page, its first line, and what does not run: lines, or the first line for all, each with its reason."""

    page: str
    line: int
    code: str
    python: bool
    left_out: tuple[tuple[str, str], ...]


def pages() -> list[str]:
    """Return all pages, by path from the root of the project."""
    found = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "SECURITY.md"]
    return [p.relative_to(ROOT).as_posix() for p in (*found, *sorted((ROOT / "docs").rglob("*.md")))]


def collect(page: str, text: str, left_out: tuple[tuple[str, str], ...] = LEFT_OUT) -> list[Block]:
    """Return the blocks of a page, in order; ValueError where a marker gives no reason."""
    blocks = []
    for match in FENCE.finditer(text):
        code, reason, kind = match["code"], match["reason"], match["kind"].strip()
        python = kind == "python"
        if not python and kind not in SHELLS and (kind or not code.removeprefix("$ ").startswith(PROGRAMS)):
            continue
        line = text[: match.start("code")].count("\n") + 1
        if reason is not None and not reason.strip():
            raise ValueError(f"{page}, line {line}: the marker gives no reason why the block cannot run")
        if reason is not None:
            blocks.append(Block(page, line, "", python, ((code.splitlines()[0], reason),)))
            continue
        kept, left = [], []
        for command in [code] if python else [row.removeprefix("$ ") for row in code.splitlines()]:
            why = None if python else next((why for start, why in left_out if re.match(start, command)), None)
            kept.append("" if why else command)
            left += [(command, why)] if why else []
        blocks.append(Block(page, line, "\n".join(kept).strip(), python, tuple(left)))
    return blocks


def shortened(words: list[str]) -> list[str]:
    """Return the arguments of a `warpgs` command within `LIMITS`."""
    if not words or {"--help", "-h", "--help-all", "--time-budget"} & set(words):
        return words
    words = [*words]
    limits = {**LIMITS.get(words[0], {}), **({"--view-port": "0"} if "--view" in words else {})}
    for flag, most in limits.items():
        at = next((i for i, w in enumerate(words) if w.partition("=")[0] == flag), None)
        if at is None:
            words += [flag, most] if flag != "--downscale" else []
        elif "=" in words[at]:
            words[at] = f"{flag}={min(float(words[at].partition('=')[2]), float(most)):.0f}"
        else:
            words[at + 1] = f"{min(float(words[at + 1]), float(most)):.0f}"
    return words


def main_of_warpgs(words: list[str]) -> int:
    """Run a `warpgs` command shortened; the viewer is interrupted once it prints an address. Return the exit code."""
    command = [sys.executable, "-m", "warpgs.app.cli", *shortened(words)]
    if words[:1] != ["view"] or "--help" in words:
        return subprocess.run(command, check=False).returncode
    with tempfile.TemporaryFile("w+", encoding="utf-8") as output:
        plain = {**os.environ, "PYTHONUNBUFFERED": "1"}  # a file is no terminal: lines would stay in a buffer
        signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background would ignore it, and its children
        process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT, env=plain)
        told = False
        try:
            for _ in range(10 * VIEWER_TIME):
                try:
                    process.wait(0.1)
                    break
                except subprocess.TimeoutExpired:
                    output.seek(0)
                    told = "http://" in output.read()
                    if told:
                        break
            process.send_signal(signal.SIGINT)
            ended = process.wait(VIEWER_TIME)
        except subprocess.TimeoutExpired:
            print("the viewer did not end")
            return 1
        finally:
            process.kill()
        output.seek(0)
        print(output.read())
        return 0 if told and ended in (0, 130) else 1


def _run(words: list[str], folder: Path, programs: Path | None, code: str = "") -> str:
    """Run a program in a folder; return an error message, or an empty text."""
    first = [str(programs), str(Path(sys.executable).parent)] if programs else []
    path = os.pathsep.join([*first, os.environ.get("PATH", "")])
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as output:
        process = subprocess.Popen(
            words, cwd=folder, env={**os.environ, "PATH": path}, stdin=subprocess.PIPE, stdout=output, text=True,
            encoding="utf-8", stderr=subprocess.STDOUT, start_new_session=True,
        )  # fmt: skip
        try:
            process.communicate(code, TIME)
            why = f"exit code {process.returncode}" if process.returncode else ""
        except subprocess.TimeoutExpired:
            why = f"not done after {TIME} s"
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
        output.seek(0)
        return "\n    ".join([why, *output.read().splitlines()[-5:]]) if why else ""


def run_block(block: Block, folder: Path, programs: Path | None) -> tuple[str, Path]:
    """Run a block in a folder; return an error message or an empty text, and the last folder of a shell."""
    if block.python:
        return _run([sys.executable, "-"], folder, programs, block.code), folder
    if not block.code:
        return "", folder
    with tempfile.TemporaryDirectory() as place:
        file = Path(place) / "folder"
        why = _run(["bash", "-e", "-c", f'{block.code}\npwd > "$0"', str(file)], folder, programs)
        return why, folder if why else Path(file.read_text("utf-8").rstrip("\n"))


def run_blocks(blocks: list[Block], folder: Path, programs: Path | None) -> list[str]:
    """Run the blocks of a page in order, each in the last folder of the block before; return a line for each failed block."""
    failed = []
    for block in blocks:
        why, folder = run_block(block, folder, programs)
        if why:
            failed.append(f"{block.page}, line {block.line}: {why}")
    return failed


def write_program(folder: Path) -> None:
    """Write the program `warpgs` that shortens commands."""
    program = folder / "warpgs"
    program.write_text(
        f"#!{sys.executable}\nimport sys\nsys.path.insert(0, {str(ROOT)!r})\nfrom tools.run_docs import main_of_warpgs\n"
        "sys.exit(main_of_warpgs(sys.argv[1:]))\n"
    )
    program.chmod(0o755)


def prepare(folder: Path, code: str, made: Path) -> None:
    """Put the files that the blocks of a page use but do not make into its folder."""
    own = {word.strip("'\"),").rstrip("/") for word in re.findall(r"(?:warpgs demo |--out[ =]|out=)(\S+)", code)}
    for name in INPUTS:
        if name not in own and re.search(rf"(?<![\w./-]){re.escape(name)}\b", code):
            source = ROOT / name if name == "examples" else made / name
            (shutil.copytree if source.is_dir() else shutil.copy)(source, folder / name)


def run_page(page: str, made: Path, programs: Path) -> tuple[int, list[str], list[str]]:
    """Run the blocks of a page; return their number, a line for each failed block, and one for each left-out line."""
    blocks = collect(page, (ROOT / page).read_text("utf-8"))
    folder = made.parent / page.replace("/", "-")
    folder.mkdir()
    prepare(folder, "\n".join(b.code for b in blocks), made)
    failed = run_blocks(blocks, folder, programs)
    left = [f"{page}, line {b.line}: {words.split('  ')[0]} ({why})" for b in blocks for words, why in b.left_out]
    return sum(bool(b.code) for b in blocks), failed, left


def install(folder: Path) -> list[str]:
    """Type docs/install.md into a fresh copy of the project; return a line for each block that failed."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"], cwd=ROOT, capture_output=True, check=True
    )
    for name in filter(None, listed.stdout.decode().split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, folder / name)
    return run_blocks(collect(INSTALL, (ROOT / INSTALL).read_text("utf-8"), ()), folder, None)


def main(arguments: list[str] | None = None) -> int:
    """Run all pages, or the named ones; return 1 if a block failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("page", nargs="*", help="a page, such as README.md or docs/mesh.md; default: all")
    parser.add_argument("--install", action="store_true", help=f"type {INSTALL} in a fresh copy, with a network")
    a = parser.parse_args(arguments)
    unknown = [page for page in a.page if page not in pages()]
    if unknown:
        parser.error(f"no such page: {', '.join(unknown)}; give paths from the root of the project, such as docs/mesh.md")
    failed, left = [], []
    with tempfile.TemporaryDirectory(prefix="docs-run-") as name:
        made, programs = Path(name) / "made", Path(name) / "bin"
        made.mkdir()
        if a.install:
            failed = install(made)
            print("\n".join(failed) or f"{INSTALL}: installed")
            return int(bool(failed))
        programs.mkdir()
        write_program(programs)
        why = _run(["bash", "-e", "-c", MAKE_INPUTS], made, programs)
        if why:
            print(f"the inputs of pages could not be made: {why}")
            return 1
        for page in a.page or pages():
            ran, wrong, rest = run_page(page, made, programs)
            if ran or rest:
                print(f"{page}: {ran} blocks ran, {len(wrong)} failed, {len(rest)} left out", *wrong, sep="\n", flush=True)
            failed += wrong
            left += rest
    print("\n".join(["", "left out:", *left, "", f"{len(failed)} blocks failed"]))
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
