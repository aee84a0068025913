"""Real disks that are full, have no room for names, cannot be written, or whose folders go away.

They are small file systems in memory, which only root of a Linux machine may mount; elsewhere their tests are skipped.
`make test-fault` tries one size of each kind, WARPGS_KILLS=200 all.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import warpgs
from tests.faults.test_save_faults import REMEDY
from tests.faults.tiny_runs import OWN, SAME_BYTES, STEPS, VIEWS, check_whole, digests, leftovers, words_of
from warpgs.app.cli import main
from warpgs.errors import ResourceError
from warpgs.pipeline.run.folder import load_checkpoint
from warpgs.pipeline.train.presets import PRESETS
from warpgs.synthetic.demo import split_spec

pytestmark = pytest.mark.fault
MANY = int(os.environ.get("WARPGS_KILLS", "0")) >= 100
KIB = 1024


def sizes(*values: int) -> tuple[int, ...]:
    """Return all values, or the middle one."""
    return values if MANY else values[len(values) // 2 :][:1]


def mount(*words: str) -> str:
    """Call mount; returns what it says if it fails."""
    return subprocess.run(["mount", *words], capture_output=True, text=True, check=False).stderr


@pytest.fixture
def disk(tmp_path) -> Iterator[Callable[[str], Path]]:
    """A function that mounts a file system in memory with options, or mounts it anew with others, and returns its folder."""
    folder = tmp_path / "disk"
    folder.mkdir()
    if not sys.platform.startswith("linux") or shutil.which("mount") is None:
        pytest.skip("no Linux mount")

    def mounted(options: str) -> Path:
        again = "remount," if os.path.ismount(folder) else ""
        refused = mount("-t", "tmpfs", "-o", again + options, "tmpfs", str(folder))
        if refused:
            pytest.skip(f"mount: {refused.strip()}")
        return folder

    yield mounted
    if os.path.ismount(folder):
        subprocess.run(["umount", "-l", str(folder)], check=True)


def used(folder: Path) -> int:
    """Bytes taken on the disk of a folder."""
    return shutil.disk_usage(folder).used


def check_refused(work: Path, before: dict[str, str], said: str) -> None:
    """The last words are ours, nothing is lost or half, and nothing is left over."""
    assert "defect" not in said and "Traceback" not in said and REMEDY.search(said), said
    check_whole(work, ended=False)
    assert leftovers(work) == [] and before.keys() <= digests(work).keys(), said


def check_right(reference, command: str, work: Path, before: dict[str, str]) -> None:
    """The command's results are there."""
    assert leftovers(work) == []
    check_whole(work, ended=True)
    for path, digest in digests(work).items():
        if not path.startswith(OWN[command]):
            assert digest == before[path], path
        elif path.endswith(SAME_BYTES) and path != "run/checkpoint.safetensors":  # it holds notes on images that did not fit
            assert digest == reference.after[command][path], path
    if command == "fit":
        check_tensors(reference.folder / "finished" / "run", work / "run")


def check_tensors(wanted: Path, found: Path) -> None:
    """Two checkpoints hold the same numbers."""
    (a, _), (b, _) = load_checkpoint(wanted), load_checkpoint(found)
    assert a.keys() == b.keys() and all(torch.equal(a[n], b[n]) for n in a)


def check_command(reference, command, work, before, capfd, make_room):
    """A command comes to its end, or is refused with nothing lost and comes to its end once there is room."""
    code = main(words_of(command, reference.scene, work))
    said = capfd.readouterr().err
    if code:
        assert code == 4, said
        check_refused(work, before, said)
        make_room()
        again = "resume" if command == "fit" and (work / "run" / "config.json").is_file() else command
        assert main(words_of(again, reference.scene, work)) == 0
    check_right(reference, command, work, before)


@pytest.mark.parametrize("command", ["fit", "render", "export", "convert", "mesh", "eval", "prune"])
@pytest.mark.parametrize("room", sizes(0, 4 * KIB, 8 * KIB, 16 * KIB, 32 * KIB, 64 * KIB, 128 * KIB, 512 * KIB, 8192 * KIB))
def test_a_disk_that_fills(reference, disk, capfd, command, room):
    """What was there before stays, and with more room the command comes to its end."""
    work = disk("size=64m") / "work"
    reference.before(command, work)
    before = digests(work)
    disk(f"size={max(used(work) + room, 4 * KIB)}")
    check_command(reference, command, work, before, capfd, lambda: disk("size=64m"))


@pytest.mark.parametrize("command", ["fit", "render", "export", "prune"] if MANY else ["render"])
@pytest.mark.parametrize("names", sizes(0, 1, 2, 3, 5, 8, 13))
def test_a_disk_without_room_for_names(reference, disk, capfd, command, names):
    work = disk("size=64m,nr_inodes=1000") / "work"
    reference.before(command, work)
    before = digests(work)
    there = os.statvfs(work)
    disk(f"nr_inodes={there.f_files - there.f_ffree + names}")
    check_command(reference, command, work, before, capfd, lambda: disk("nr_inodes=1000"))


@pytest.mark.parametrize("command", ["fit", "resume", "render", "export", "convert", "mesh", "eval", "prune"])
def test_a_disk_that_cannot_be_written(reference, disk, capfd, command):
    work = disk("size=64m") / "work"
    reference.before(command, work)
    before = digests(work)
    disk("ro")
    assert main(words_of(command, reference.scene, work)) == 4
    check_refused(work, before, capfd.readouterr().err)
    assert digests(work) == before


@pytest.mark.parametrize("folder", ["in a file", "file", *["mount point"] * MANY])
def test_places_for_a_run(reference, disk, capfd, folder):
    """A mount point is a folder like any other, and stays one; a file is none."""
    work = disk("size=4k")
    words = words_of("fit", reference.scene, work)
    if folder == "mount point":
        words = [str(work) if w == str(work / "run") else w for w in words]
        assert main(words) == 4
        assert leftovers(work) == [] and os.path.ismount(work)
        disk("size=64m")
        again = [*words, "--resume"] if (work / "config.json").is_file() else words
        assert main(again) == 0
        assert digests(work)["point_cloud.ply"] == reference.after["fit"]["run/point_cloud.ply"]
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
    config = replace(PRESETS["quick"], steps=STEPS, checkpoint_every=10, checkpoint_seconds=0)

    def go_away(report) -> None:
        if report.step == 15:
            out.rename(tmp_path / "gone")  # at once: a thread may be writing an image into it
            if what == "a file":
                out.write_text("the user's own")

    with pytest.raises(ResourceError, match="cannot be written") as e:
        warpgs.fit(
            reference.scene, config, split=split_spec(VIEWS), out=out, device="cpu", on_step=go_away, verbose=False
        )  # fmt: skip
    assert REMEDY.search(str(e.value))
    assert out.read_text() == "the user's own" if what == "a file" else not out.exists()
