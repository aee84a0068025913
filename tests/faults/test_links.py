"""Every command over a tree of results with a link at every place that it writes: nothing that a link leads to is touched.

What a command writes is known from its own calls (`Reference.calls`). Each of these places, and each folder on the way to it
below the folder that the user names, becomes a link in turn to something outside, and the command runs. It ends well, and has
replaced the link, or with an error of ours.
"""

import os
import shutil
from pathlib import Path

import pytest

from tests.faults.tiny_runs import NEEDS, OWN, Reference, can_run, child, digests, is_temporary, words_of

pytestmark = [pytest.mark.fault, pytest.mark.skipif(os.name == "nt", reason="links need a right that users often lack")]
MANY = int(os.environ.get("WARPGS_KILLS", "0")) >= 100
ROOTS = {
    "fit": "run", "resume": "run", "eval": "run", "view": "run", "render": "film", "compare": "study", "worker": "results",
    "farm": "results", "poses": "posed", "prune": "run-pruned",
}  # fmt: skip
"""Folder that the user names to a command; the others name a file, beside which only its own name counts."""
REACHED = "exit code 0, 2, 3 or 4"


def places_of(reference: Reference, command: str) -> list[tuple[str, bool]]:
    """Return all places below the named folder that a command writes, and whether each is a folder."""
    files, folders = set(), set()
    for kind, path, _ in reference.calls[command]:
        if kind in ("open", "replace", "mkdir") and not is_temporary(path) and path.startswith(OWN[command]):
            (folders if kind == "mkdir" else files).add(path)
    for path in [*files, *folders]:
        folders |= {p.as_posix() for p in Path(path).parents}
    root = ROOTS.get(command)
    inside = {p for p in files | folders if root is None or (p.startswith(f"{root}/") and p != root)}
    return sorted((p, p in folders) for p in inside if p not in (".", "") and not (root is None and p in folders))


def plant(work: Path, outside: Path, place: str, is_folder: bool) -> None:
    """Put a link at a place: to a copy outside of what is there, or to what could be there."""
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


def check(reference: Reference, tmp_path: Path, command: str, planted: list[tuple[str, bool]]) -> str:
    """Run a command with links planted; return how it ended."""
    work, outside = tmp_path / "work", tmp_path / "outside"
    for folder in (work, outside):
        shutil.rmtree(folder, ignore_errors=True)
    reference.before(command, work)
    outside.mkdir()
    for place, is_folder in planted:
        plant(work, outside, place, is_folder)
    before, modes = digests(outside), {p: p.lstat().st_mode for p in outside.rglob("*")}
    done = child(work, words_of(command, reference.scene, work))
    said = f"{command} with a link at {planted}: {done.said}"
    assert digests(outside) == before and {p: p.lstat().st_mode for p in outside.rglob("*")} == modes, said
    assert done.code in (0, 2, 3, 4) and "defect" not in done.said and "Traceback" not in done.said.split("warpgs:")[-1], said
    for place, is_folder in planted:
        assert done.code or not (work / place).is_symlink() or is_folder, said
    return "replaced" if done.code == 0 else done.said


@pytest.mark.parametrize("command", [c for c in OWN if MANY or c in ("eval", "render", "export")])
def test_no_command_writes_through_a_link(reference, tmp_path, record_property, command):
    if not can_run(command):
        pytest.skip(f"{NEEDS[command]} is not installed")
    places = places_of(reference, command)
    assert places
    ended = {place: check(reference, tmp_path, command, [(place, is_folder)]) for place, is_folder in places}
    for place, is_folder in places:
        if is_folder:
            assert "is a link" in ended[place] or "exists already" in ended[place], (place, ended[place])
    record_property("links", f"{command} {len(places)}, {sum(e == 'replaced' for e in ended.values())} replaced")
