"""Run the shell commands of the README and of the pages for users, as a reader would type them (`make docs-run`).

Each page has a temporary folder of its own, in which its blocks run one after the other. What a page uses and does not make
itself is put there first: `scene` (the demo scene, small), `photos` (its images alone) and `run` (a short fit). A program
`warpgs` before all others on the path adds flags that make commands short; see `shortened`.

A block that cannot run here stands below a comment with the reason, `<!-- docs-run: REASON -->`. Single lines that begin with
what `LEFT_OUT` names are left out, too. Both are counted.
"""

from __future__ import annotations

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
PAGES = (
    "README.md", "docs/install.md", "docs/quickstart.md", "docs/your-photos.md", "docs/poses.md", "docs/viewer.md",
    "docs/films.md", "docs/mesh.md", "docs/formats.md",
)  # fmt: skip
"""Pages for users; those that are not there are passed over."""
FENCE = re.compile(
    r"(?:<!-- docs-run: (?P<reason>[^\n]*?) -->\s*\n)?^```(?P<kind>[^\n`]*)\n(?P<code>.*?)^```", re.DOTALL | re.MULTILINE
)
SHELLS = {"bash", "sh", "shell", "console"}
PROGRAMS = ("warpgs ", "pip ", "ssh ", "make ", "python ", "git ")
"""First words of a block without a language that make it one for a shell."""
LEFT_OUT = (
    (r"(sudo |apt|brew|git|curl|wget|ssh|pip|python3? -m (pip|venv))\b", "network or another machine"),
    (r"(make|source|\.) ", "the reader's environment"),
    (r"warpgs view\b", "stays open"),
    (r"warpgs .*--device cuda\b", "GPU"),
)
"""Beginnings of lines that are left out, and why."""
LIMIT = 900
"""Seconds that a block may take."""


@dataclass(frozen=True)
class Block:
    """A block of shell commands in a page."""

    page: str
    """Path of the page from the root of the project."""
    line: int
    """Line of the page in which its first command stands."""
    code: str
    """Commands that run."""
    left_out: tuple[str, ...]
    """Reasons, one for each line that does not run, or for the whole block."""


def collect(page: str, text: str) -> list[Block]:
    """Return the blocks of shell commands of a page, in order; ValueError where a marker gives no reason."""
    blocks = []
    for match in FENCE.finditer(text):
        code, reason = match["code"], match["reason"]
        if match["kind"].strip() not in SHELLS and (match["kind"] or not code.removeprefix("$ ").startswith(PROGRAMS)):
            continue
        line = text[: match.start("code")].count("\n") + 1
        if reason is not None and not reason.strip():
            raise ValueError(f"{page}, line {line}: the marker says not why the block cannot run")
        if reason is not None:
            blocks.append(Block(page, line, "", (reason,)))
            continue
        kept, reasons = [], []
        for command in (row.removeprefix("$ ") for row in code.splitlines()):
            why = next((why for start, why in LEFT_OUT if re.match(start, command)), None)
            kept.append("" if why else command)
            reasons += [why] if why else []
        blocks.append(Block(page, line, "\n".join(kept).strip(), tuple(reasons)))
    return blocks


def shortened(words: list[str]) -> list[str]:
    """Return the words of a `warpgs` command with few steps, frames, seeds and pixels, where it does not say how many."""
    few = {
        "fit": {"--steps": "40"}, "compare": {"--steps": "20", "--seeds": "1"}, "ablate": {"--steps": "20", "--seeds": "1"},
        "render": {"--frames": "4"}, "demo": {"--width": "96", "--height": "72"},
    }  # fmt: skip
    stop = {"--help", "-h", "--help-all", "--time-budget", "--seconds"}
    if not words or stop & set(words):
        return words
    given = {word.partition("=")[0] for word in words}
    return words + [w for flag, value in few.get(words[0], {}).items() if flag not in given for w in (flag, value)]


def _shell(code: str, folder: Path, programs: Path) -> str:
    """Run commands in bash until one fails; return what is wrong, empty where nothing is."""
    path = os.pathsep.join([str(programs), str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as output:
        process = subprocess.Popen(
            ["bash", "-e", "-c", code], cwd=folder, env={**os.environ, "PATH": path}, stdin=subprocess.DEVNULL, stdout=output,
            stderr=subprocess.STDOUT, start_new_session=True,
        )  # fmt: skip
        try:
            ended = process.wait(LIMIT)
            why = f"exit code {ended}" if ended else ""
        except subprocess.TimeoutExpired:
            why = f"not done after {LIMIT} s"
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
        output.seek(0)
        return "\n    ".join([why, *output.read().splitlines()[-5:]]) if why else ""


def write_program(folder: Path) -> None:
    """Write the program `warpgs` that runs short."""
    program = folder / "warpgs"
    program.write_text(
        f"#!{sys.executable}\nimport sys\nsys.path.insert(0, {str(ROOT)!r})\nfrom tools.run_docs import shortened\n"
        "from warpgs.app.cli import main\nsys.exit(main(shortened(sys.argv[1:])))\n"
    )
    program.chmod(0o755)


def _prepare(folder: Path, code: str, made: Path) -> None:
    """Put into the folder of a page what its commands use and do not make."""
    own = {word.strip("'\"").rstrip("/") for word in re.findall(r"(?:warpgs demo|--out)[ =](\S+)", code)}
    for name in ("scene", "photos", "run"):
        if name not in own:
            shutil.copytree(made / name, folder / name)


def run_blocks(blocks: list[Block], folder: Path, programs: Path) -> list[str]:
    """Run the blocks of a page in order; return a line for each that failed."""
    failed = []
    for block in blocks:
        why = _shell(block.code, folder, programs) if block.code else ""
        if why:
            failed.append(f"{block.page}, line {block.line}: {why}")
    return failed


def main() -> int:
    """Run all pages, or those named; returns 1 where a block failed."""
    failed: list[str] = []
    pages = [p for p in (sys.argv[1:] or PAGES) if (ROOT / p).is_file()]
    with tempfile.TemporaryDirectory(prefix="docs-run-") as name:
        made, programs = Path(name) / "made", Path(name) / "bin"
        made.mkdir()
        programs.mkdir()
        write_program(programs)
        why = _shell("warpgs demo scene --views 8 && cp -r scene/images photos && warpgs fit scene --out run", made, programs)
        if why:
            print(f"the scene and the run that pages start from: {why}")
            return 1
        for page in pages:
            blocks = collect(page, (ROOT / page).read_text("utf-8"))
            folder = Path(name) / page.replace("/", "-")
            folder.mkdir()
            _prepare(folder, "\n".join(b.code for b in blocks), made)
            wrong = run_blocks(blocks, folder, programs)
            ran, left = sum(bool(b.code) for b in blocks), [why for b in blocks for why in b.left_out]
            about = "; ".join(f"{left.count(why)} x {why}" for why in sorted(set(left)))
            print(
                f"{page}: {ran} blocks ran, {len(wrong)} failed, {len(left)} left out{f' ({about})' if about else ''}",
                flush=True,
            )
            failed += wrong
    print("\n".join(failed))
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
