"""Saves that fail: a fault at every call, and on real disks that are full."""

import errno
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

import warpgs
from tests.faults import tiny_runs
from tests.faults.calls import Call, numbered
from warpgs.app.cli import main
from warpgs.errors import ResourceError
from warpgs.export.ply import write_ply
from warpgs.files import write_json
from warpgs.locks import hold_folder
from warpgs.pipeline.films.film import render_path
from warpgs.pipeline.model import table
from warpgs.pipeline.model.edit import limit_degree
from warpgs.pipeline.run.commands import _write, evaluate
from warpgs.pipeline.run.export import export
from warpgs.pipeline.run.folder import StoredRun, load_checkpoint, open_run, save_checkpoint
from warpgs.pipeline.train.presets import PRESETS
from warpgs.report.film import write_film
from warpgs.report.progress import EventLog
from warpgs.synthetic.demo import split_spec

# A fault at every call of every way of saving: an error of ours, nothing lost, nothing left over, and the next time it works.
# Every call is numbered once; then each fails in turn, in each of the ways below, and the same is saved again without a fault.

pytestmark = pytest.mark.fault
MANY = int(os.environ.get("WARPGS_KILLS", "0")) >= 100
ERRORS = (errno.ENOSPC, errno.EIO, errno.EACCES, errno.EDQUOT)
REMEDY = re.compile(r"[Ff]ree some disk space|[Cc]hoose another|choose a folder|check the disk|[Ww]rite elsewhere")


@dataclass(frozen=True)
class Fault:
    """One way in which a call fails: an error, an interruption, or half a write, which the file system tells or not."""

    name: str
    error: int = 0

    def __call__(self, call: Call) -> int | None:
        if self.error:
            raise OSError(self.error, os.strerror(self.error), str(call.path))
        if self.name == "interrupt":
            raise KeyboardInterrupt
        if call.half is None:
            return None
        half = call.half()
        return half if self.name == "short" else call.size


FAULTS = [Fault(errno.errorcode[e], e) for e in ERRORS] + [Fault(n) for n in ("interrupt", "short", "lost")]


@dataclass(frozen=True)
class Saved:
    """What is saved: a model in two states, of which one is there before."""

    run: StoredRun
    folder: Path
    number: int
    """0 for what is there before, 1 for what takes its place."""

    @property
    def gaussians(self):
        g = self.run.gaussians()
        return replace(g, means=g.means + self.number)


def save_log(s: Saved) -> None:
    """Every part of a log's life: opened anew, written, flushed, shortened, closed."""
    log = EventLog(s.folder / "metrics.jsonl")
    try:
        for step in range(1, 4):
            log.write(step=step, loss=0.5 + s.number)
        log.flush()
        log.rewind(2)
        log.write(step=3, loss=0.25 + s.number)
    finally:
        log.close()


def save_film(s: Saved) -> None:
    write_film(s.folder / "film.mp4", (np.full((36, 48, 3), (i + s.number) / 8, np.float32) for i in range(4)))


def save_path(s: Saved) -> None:
    cameras = [s.run.scene_cameras[n] for n in sorted(s.run.scene_cameras)[s.number : s.number + 2]]
    render_path(s.run, cameras, out=s.folder / "film")


def save_pruned(s: Saved) -> None:
    """Into a folder that must not be there yet."""
    if not s.number:
        return
    if (s.folder / "pruned").exists():  # then the next command is another one
        with hold_folder(s.folder):
            return
    _write(s.folder / "pruned", s.run, {"source": "run"}, limit_degree(s.gaussians, 0))


def save_held(s: Saved) -> None:
    with hold_folder(s.folder / "a" / "b", "renders"):
        write_json(s.folder / "a" / "b" / "c.json", {"number": s.number})


def save_export(s: Saved) -> None:
    """Of a run beside, so that it is what is there before and after."""
    if not s.number:
        write_ply(s.folder / "a.ply", s.gaussians, s.run.normalization, units="file")
    else:
        export(s.run.folder, s.folder / "a.ply")


def save_scores(s: Saved) -> None:
    if not s.number:
        shutil.copytree(s.run.folder, s.folder / "run")
    else:
        evaluate(s.folder / "run", "cpu")


WAYS: dict[str, Callable[[Saved], object]] = {
    "json": lambda s: write_json(s.folder / "a.json", {"number": [s.number] * 100}),
    "ply": lambda s: write_ply(s.folder / "a.ply", s.gaussians, s.run.normalization),
    "checkpoint": lambda s: save_checkpoint(s.folder, s.gaussians.tensors(), {"step": s.number}),
    "model": lambda s: table.save(s.folder / "a.model", s.gaussians, s.run.normalization),
    "log": save_log,
    "film": save_film,
    "path": save_path,
    "pruned": save_pruned,
    "held": save_held,
    "export": save_export,
    "scores": save_scores,
}


def calls_of(save: Callable[[Saved], object], state: Saved) -> list[Call]:
    calls: list[Call] = []
    with numbered(state.folder, calls.append):
        save(state)
    return calls


def failing(save: Callable[[Saved], object], state: Saved, number: int, fault: Fault) -> tuple[str, Call | None]:
    """Save with a fault at one call; returns how it ended, and the call."""
    hit: list[Call] = []

    def before(call: Call) -> int | None:
        if call.number != number:
            return None
        hit.append(call)
        return fault(call)

    try:
        with numbered(state.folder, before):
            save(state)
    except ResourceError as e:
        assert REMEDY.search(str(e)) and str(state.folder) in str(e), str(e)
        return "refused", hit[0]
    except KeyboardInterrupt:
        assert fault.name == "interrupt"
        return "interrupted", hit[0]
    return "saved", hit[0] if hit else None


@pytest.mark.parametrize("way", WAYS)
def test_a_fault_at_every_call(reference, tmp_path, record_property, way):
    save = WAYS[way]
    run = open_run(reference.folder / "finished" / "run", "cpu")
    old, new, work = (tmp_path / n for n in ("old", "new", "work"))
    for folder, numbers in ((old, (0,)), (new, (0, 1))):
        folder.mkdir()
        for number in numbers:
            save(Saved(run, folder, number))
    shutil.copytree(old, work)
    calls = calls_of(save, Saved(run, work, 1))
    assert_saved(work, new)
    faults = [(n, f) for n, c in enumerate(calls, 1) for f in FAULTS if can_be(f, c)]
    if way == "scores" and not MANY:
        faults = faults[:: len(faults) // 4]  # each takes a whole scoring
    for number, fault in faults:
        shutil.rmtree(work)
        shutil.copytree(old, work)
        state = Saved(run, work, 1)
        ended, call = failing(save, state, number, fault)
        what = f"{way}: {fault.name} at call {number}, {call and call.kind} {call and call.path.name}: {ended}"
        save_check_after_fault(way, call, ended, work, old, new, what)
        save(state)
        assert_saved(work, new, what)
    record_property("faults", f"{way} {len(faults)} of {len(calls)} calls")


def can_be(fault: Fault, call: Call) -> bool:
    """Return whether a call can fail so; nobody can tell what a file system lost of a log, which ends where it ends."""
    if call.kind == "step":
        return False
    if fault.name == "lost":
        return call.kind == "write" and call.path.name != "metrics.jsonl"
    return call.kind == "write" or fault.name != "short"


def save_check_after_fault(way: str, call: Call | None, ended: str, work: Path, old: Path, new: Path, what: str) -> None:
    """Everything is as before or as it is to be; only a temporary file whose removal failed may be left."""
    if ended == "saved":
        assert_saved(work, new, what, left=call is not None and call.kind == "unlink")
        return
    now, was, wanted = tiny_runs.digests(work), tiny_runs.digests(old), tiny_runs.digests(new)
    left = [p for p in now if tiny_runs.is_temporary(p)]
    # a lock file that is not ours may be another's
    assert not left or (call.kind in ("unlink", "lock") and len(left) == 1), f"{what}: {left}"
    kept = [p for p in now if p not in left]
    if way == "log":  # it grows by lines
        lines = (work / "metrics.jsonl").read_bytes().split(b"\n")
        assert all(line.startswith(b'{"step"') and line.endswith(b"}") for line in lines[:-1]), what
        return
    assert was.keys() <= set(kept), f"{what}: lost"
    for path in kept:
        if path.endswith(tiny_runs.SAME_BYTES):
            assert now[path] in (was.get(path), wanted.get(path)), f"{what}: {path}"


def assert_saved(work: Path, new: Path, what: str = "", left: bool = False) -> None:
    now, wanted = tiny_runs.digests(work), tiny_runs.digests(new)
    if left:
        now = {p: d for p, d in now.items() if not tiny_runs.is_temporary(p)}
    assert now.keys() == wanted.keys(), what
    for path in now:
        if path.endswith(tiny_runs.SAME_BYTES) or path == "metrics.jsonl":
            assert now[path] == wanted[path], f"{what}: {path}"
        elif path == "a.model":  # its header has no order
            found = [table.load(f / path).gaussians().means for f in (work, new)]
            assert torch.equal(*found), what


# Real disks that are full, have no room for names, cannot be written, or whose folders go away: small file systems in memory,
# which only root of a Linux machine may mount. `make test-fault` tries one size of each kind, WARPGS_KILLS=200 all.

KIB = 1024


def sizes(*values: int) -> tuple[int, ...]:
    return values if MANY else values[len(values) // 2 :][:1]


@pytest.fixture
def disk(tmp_path) -> Iterator[Callable[[str], Path]]:
    folder = tmp_path / "disk"
    folder.mkdir()
    if not sys.platform.startswith("linux") or shutil.which("mount") is None:
        pytest.skip("no Linux mount")

    def mounted(options: str) -> Path:
        again = "remount," if os.path.ismount(folder) else ""
        words = ["mount", "-t", "tmpfs", "-o", again + options, "tmpfs", str(folder)]
        if refused := subprocess.run(words, capture_output=True, text=True, check=False).stderr:
            pytest.skip(f"mount: {refused.strip()}")
        return folder

    yield mounted
    if os.path.ismount(folder):
        subprocess.run(["umount", "-l", str(folder)], check=True)


def check_refused(work: Path, before: dict[str, str], said: str) -> None:
    """The last words are ours, nothing is lost or half, and nothing is left over."""
    assert "defect" not in said and "Traceback" not in said and REMEDY.search(said), said
    tiny_runs.check_whole(work, ended=False)
    assert tiny_runs.leftovers(work) == [] and before.keys() <= tiny_runs.digests(work).keys(), said


def check_right(reference, command: str, work: Path, before: dict[str, str]) -> None:
    assert tiny_runs.leftovers(work) == []
    tiny_runs.check_whole(work, ended=True)
    for path, digest in tiny_runs.digests(work).items():
        if not path.startswith(tiny_runs.OWN[command]):
            assert digest == before[path], path
        elif (
            path.endswith(tiny_runs.SAME_BYTES) and path != "run/checkpoint.safetensors"
        ):  # it holds notes on images that did not fit
            assert digest == reference.after[command][path], path
    if command == "fit":
        a, b = (load_checkpoint(folder / "run")[0] for folder in (reference.folder / "finished", work))
        assert a.keys() == b.keys() and all(torch.equal(a[n], b[n]) for n in a)


def check_command(reference, command, work, before, capfd, make_room):
    """A command comes to its end, or is refused with nothing lost and comes to its end once there is room."""
    code = main(tiny_runs.words_of(command, reference.scene, work))
    said = capfd.readouterr().err
    if code:
        assert code == 4, said
        check_refused(work, before, said)
        make_room()
        again = "resume" if command == "fit" and (work / "run" / "config.json").is_file() else command
        assert main(tiny_runs.words_of(again, reference.scene, work)) == 0
    check_right(reference, command, work, before)


@pytest.mark.parametrize("command", ["fit", "render", "export", "convert", "mesh", "eval", "prune"])
@pytest.mark.parametrize("room", sizes(0, 4 * KIB, 8 * KIB, 16 * KIB, 32 * KIB, 64 * KIB, 128 * KIB, 512 * KIB, 8192 * KIB))
def test_a_disk_that_fills(reference, disk, capfd, command, room):
    work = disk("size=64m") / "work"
    reference.before(command, work)
    before = tiny_runs.digests(work)
    disk(f"size={max(shutil.disk_usage(work).used + room, 4 * KIB)}")
    check_command(reference, command, work, before, capfd, lambda: disk("size=64m"))


@pytest.mark.parametrize("command", ["fit", "resume", "render", "export", "convert", "mesh", "eval", "prune"])
def test_a_disk_that_cannot_be_written(reference, disk, capfd, command):
    work = disk("size=64m") / "work"
    reference.before(command, work)
    before = tiny_runs.digests(work)
    disk("ro")
    assert main(tiny_runs.words_of(command, reference.scene, work)) == 4
    check_refused(work, before, capfd.readouterr().err)
    assert tiny_runs.digests(work) == before


@pytest.mark.parametrize("folder", ["in a file", "file", *["mount point"] * MANY])
def test_places_for_a_run(reference, disk, capfd, folder):
    work = disk("size=4k")
    words = tiny_runs.words_of("fit", reference.scene, work)
    if folder == "mount point":
        words = [str(work) if w == str(work / "run") else w for w in words]
        assert main(words) == 4
        assert tiny_runs.leftovers(work) == [] and os.path.ismount(work)
        disk("size=64m")
        again = [*words, "--resume"] if (work / "config.json").is_file() else words
        assert main(again) == 0
        assert tiny_runs.digests(work)["point_cloud.ply"] == reference.after["fit"]["run/point_cloud.ply"]
    else:
        (work / "run").write_text("the user's own")
        if folder == "in a file":
            words = [str(work / "run" / "below") if w == str(work / "run") else w for w in words]
        assert main(words) in (2, 4)
        assert (work / "run").read_text() == "the user's own"
    said = capfd.readouterr().err
    assert "defect" not in said and "Traceback" not in said, said


@pytest.mark.parametrize("what", ["a file", *["deleted"] * MANY])
def test_a_run_folder_that_goes_away(reference, tmp_path, what):
    """The fit ends with an error of ours at its next checkpoint, and what stands there now is left alone."""
    out = tmp_path / "run"
    config = replace(PRESETS["quick"], steps=tiny_runs.STEPS, checkpoint_every=10)

    def go_away(report) -> None:
        if report.step == 15:
            out.rename(tmp_path / "gone")  # at once: a thread may be writing an image into it
            if what == "a file":
                out.write_text("the user's own")

    with pytest.raises(ResourceError, match="cannot be written") as e:
        warpgs.fit(
            reference.scene, config, split=split_spec(tiny_runs.VIEWS), out=out, device="cpu", on_step=go_away, verbose=False
        )  # fmt: skip
    assert REMEDY.search(str(e.value))
    assert out.read_text() == "the user's own" if what == "a file" else not out.exists()
