"""Run all commands that write, and compare what is there at the end with what Python saw being opened and renamed."""

import os
import shutil  # noqa: F401  (looks at os.open when it is imported)
import sys
from pathlib import Path

out = Path(sys.argv[1]).resolve()
out.mkdir()
opened: set[Path] = set()
placed: dict[Path, Path] = {}


def note(event: str, values: tuple) -> None:
    """Keep what is opened to be written, and what is renamed, in the folder of all results."""
    if event == "open" and isinstance(values[0], str | bytes):
        _, mode, flags = values
        writes = any(c in (mode or "") for c in "wxa+") or (flags or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
        path = Path(os.path.abspath(os.fsdecode(values[0])))
        if writes and path.is_relative_to(out):
            opened.add(path)
    elif event == "os.rename":
        source, target = (path_of(name, at) for name, at in zip(values[:2], values[2:]))
        if target.is_relative_to(out):
            placed[target] = source


def path_of(name: str | bytes, at: int) -> Path:
    """Return the path of a name in an open folder, -1 for the current one."""
    return Path(os.path.abspath(os.path.join(os.readlink(f"/proc/self/fd/{at}") if at >= 0 else "", os.fsdecode(name))))


def seen_open(name: str, flags: int, *rest: object, dir_fd: int | None = None, **more: object) -> int:
    """Open a file in an open folder, which Python does not hand to the hook."""
    if dir_fd is not None and flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
        path = path_of(name, dir_fd)
        if path.is_relative_to(out):
            opened.add(path)
    return real_open(name, flags, *rest, dir_fd=dir_fd, **more)


sys.addaudithook(note)
real_open, os.open = os.open, seen_open

from warpgs.app.cli import main  # noqa: E402
from warpgs.files import LOCK, OWN_NAMES  # noqa: E402

scene, run = str(out / "scene"), str(out / "run")
cpu, split = ["--device", "cpu"], ["--split", "every:4"]
fit = ["fit", scene, "--out", run, *split, *cpu, "--steps", "30", "--preset", "quick"]
for words in (
    ["demo", scene, "--views", "8", "--width", "48", "--height", "36"],
    fit,
    [*fit, "--resume"],
    ["eval", run, *cpu],
    ["render", run, "--path", "views", *cpu],
    ["render", run, "--path", "turntable", "--frames", "3", *cpu],
    ["export", run, "--to", str(out / "a.ply")],
    ["export", run, "--to", str(out / "cameras" / "sparse")],
    ["export", run, "--to", str(out / "cameras.json")],
    ["convert", str(out / "a.ply"), str(out / "a.sog")],
    ["mesh", run, "--out", str(out / "m.glb"), "--resolution", "24", *cpu],
    ["prune", run, "--keep-psnr", "3", *cpu],
    ["priors", "show", scene, *split, "--out", str(out / "priors")],
    ["compare", scene, *split, "--out", str(out / "study"), "--presets", "3dgs,mcmc", "--seeds", "1", "--steps", "2", *cpu],
):
    assert main(words) == 0, words

folders = {p: s for p, s in placed.items() if p.is_dir()}
assert set(folders) == {out / "scene", out / "run-pruned", out / "cameras" / "sparse"}, folders
assert all(OWN_NAMES.fullmatch(source.name) for source in folders.values())
for path in opened:
    own = OWN_NAMES.fullmatch(path.name) or path.name == LOCK or path.name == "metrics.jsonl"
    assert own, f"{path} was opened to be written"
there = [p for p in out.rglob("*") if p.is_file()]
for path in there:
    # a folder that is renamed as a whole takes its files along
    was = next((source / path.relative_to(folder) for folder, source in folders.items() if folder in path.parents), path)
    assert was in placed and OWN_NAMES.fullmatch(placed[was].name), f"{path} was not put in place"
assert len(there) > 60, len(there)
assert not [p for p in there if OWN_NAMES.fullmatch(p.name) or p.name == LOCK]
print("every file was put in place as a whole")
