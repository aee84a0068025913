"""Every command over a tree of results with a link at every place that it writes or reads: nothing behind a link is touched.

What a command writes is known from its own calls (`Reference.calls`). Each folder below the one that the user names
becomes a link in turn to something outside, and the command refuses it, or sets aside what it lies in; so do its files, all at
once where it replaces them, and one by one where it refuses one.
"""

import os
import shutil
from pathlib import Path

import pytest

from tests.faults.tiny_runs import NEEDS, OWN, Reference, can_run, child, digests, is_temporary, words_of

pytestmark = [pytest.mark.fault, pytest.mark.skipif(os.name == "nt", reason="links need a right that users often lack")]
MANY = int(os.environ.get("WARPGS_KILLS", "0")) >= 100
ROOTS = {
    "fit": "run", "resume": "run", "eval": "run", "view": "run", "plot": "run", "render": "film", "compare": "study",
    "ablate": "ablation", "worker": "results", "farm": "results", "poses": "posed", "prune": "run-pruned", "priors": "sheets",
    "demo": "made",
}  # fmt: skip
"""Folder that the user names to a command; the others name a file, beside which only its own name counts."""
NEW = ("fit", "prune", "poses", "demo")
"""Commands that take no folder with something in it, and that is no link to an empty one; what they fill has a random name."""
ALIKE = ("s1", "mcmc", "no")
"""Parts of results that are written as others are."""
READING = ("plot", "export", "render", "mesh", "prune", "eval", "view", "resume")
"""Commands that read a run."""


def places_of(reference: Reference, command: str) -> list[tuple[str, bool]]:
    if command in NEW:
        return [(ROOTS[command], True)]
    files, folders = set(), set()
    for kind, path, _ in reference.calls[command]:
        if kind in ("open", "replace", "mkdir") and not is_temporary(path) and path.startswith(OWN[command]):
            (folders if kind == "mkdir" else files).add(path)
    root = ROOTS.get(command)
    if root is None:
        return sorted((p, False) for p in files)
    for path in [*files, *folders]:
        folders |= {p.as_posix() for p in Path(path).parents}
    places = [p for p in files | folders if p.startswith(f"{root}/") and not any(f"/{a}" in p for a in ALIKE)]
    return sorted((p, p in folders) for p in places)


def plant(work: Path, outside: Path, place: str, is_folder: bool) -> None:
    at, target = work / place, outside / place.replace("/", "-")
    at.parent.mkdir(parents=True, exist_ok=True)
    if at.exists():
        shutil.move(at, target)
    elif is_folder:
        target.mkdir()
    else:
        target.write_bytes(b"the user's own")
    if is_folder:
        (target / "canary").write_bytes(b"the user's own")
    at.symlink_to(target)


def read_places(reference: Reference, command: str) -> list[tuple[str, bool]]:
    """Return the places of a run that a command does not write, and whether each is a folder; of alike files one."""
    start = reference.folder / ("interrupted" if command == "resume" else "finished")
    written = {place for place, _ in places_of(reference, command)}
    alike = {(p.parent, p.suffix if p.parent.name != "run" else p.name): p for p in (start / "run").rglob("*") if p.is_file()}
    paths = [*alike.values(), *(p for p in (start / "run").rglob("*") if p.is_dir())]
    places = sorted((p.relative_to(start).as_posix(), p.is_dir()) for p in paths)
    return [(place, is_folder) for place, is_folder in places if place not in written and not is_temporary(place)]


def check(reference: Reference, tmp_path: Path, command: str, planted: list[tuple[str, bool]], foreign: bool = False) -> str:
    """Run a command with links planted, to foreign bytes where files are only read; return how it ended."""
    work, outside = tmp_path / "work", tmp_path / "outside"
    for folder in (work, outside):
        shutil.rmtree(folder, ignore_errors=True)
    reference.before(command, work)
    outside.mkdir()
    for place, is_folder in planted:
        plant(work, outside, place, is_folder)
        if foreign and not is_folder:
            (work / place).write_bytes(b"the user's own")
    before, modes = digests(outside), {p: p.lstat().st_mode for p in outside.rglob("*")}
    done = child(work, words_of(command, reference.scene, work))
    said = f"{command} with a link at {planted}: {done.said}"
    assert digests(outside) == before and {p: p.lstat().st_mode for p in outside.rglob("*")} == modes, said
    assert done.code in (0, 2, 3, 4) and "defect" not in done.said and "Traceback" not in done.said.split("warpgs:")[-1], said
    for place, _ in planted:
        assert done.code or foreign or not (work / place).is_symlink(), said
    return "replaced" if done.code == 0 else done.said


@pytest.mark.parametrize("command", [c for c in OWN if MANY or c in ("eval", "render", "export", "plot")])
def test_no_command_writes_through_a_link(reference, tmp_path, record_property, command):
    if not can_run(command):
        pytest.skip(f"{NEEDS[command]} is not installed")
    places = places_of(reference, command)
    assert places
    ended = {p[0]: check(reference, tmp_path, command, [p]) for p in places if p[1]}
    refused = ("is a link", "exists already", "is not empty")
    assert all(how == "replaced" or any(words in how for words in refused) for how in ended.values()), ended
    together = [[p for p in places if not p[1]]]
    while together:  # files that are replaced are so all at once; those that are refused are found by halves
        group = together.pop()
        how = check(reference, tmp_path, command, group)
        if how != "replaced" and len(group) > 1:
            together += [group[: len(group) // 2], group[len(group) // 2 :]]
        else:
            ended |= {place: how for place, _ in group}
    record_property("links", f"{command} {len(places)}, {sum(e == 'replaced' for e in ended.values())} replaced")


@pytest.mark.parametrize("command", [c for c in READING if MANY or c in ("plot", "export")])
def test_no_command_reads_a_run_through_a_link(reference, tmp_path, command):
    """It names the link, or goes on without what lies behind it: no error is about the bytes that are there."""
    if not can_run(command):
        pytest.skip(f"{NEEDS[command]} is not installed")
    ended = {p[0]: check(reference, tmp_path, command, [p], foreign=True) for p in read_places(reference, command)}
    assert all("is a link" in how or how == "replaced" for how in ended.values()), ended
    assert any("is a link" in how for how in ended.values())
