"""One process at a time writes into a folder, or a file; who dies gives it free; whoever comes second is told whose it is."""

import errno
import os
import platform
import subprocess
import sys

import pytest

from warpgs import folders
from warpgs.errors import ResourceError, UsageError
from warpgs.files import LOCK, is_empty
from warpgs.locks import hold_file, hold_folder

LEFT = ".warpgs-0123456789abcdef.tmp"
HOLD = """
import sys
from pathlib import Path
from warpgs.locks import hold_folder
with hold_folder(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


def refusal(folder) -> str:
    """The error of a second holder."""
    with pytest.raises(ResourceError) as e, hold_folder(folder):
        pytest.fail("held twice")
    return str(e.value)


def test_a_second_holder_is_told_whose_the_folder_is_and_impossible_paths_are_named(tmp_path, monkeypatch):
    """Number, machine, time and command of the holder; a signature without sense is of another process; impossible paths."""
    monkeypatch.setattr(sys, "argv", ["/usr/bin/warpgs", "fit", "my scene", *["x"] * 200])
    with hold_folder(tmp_path) as notes:
        said = refusal(tmp_path)
        assert f"process {os.getpid()} on {platform.node()}, since 20" in said and "`warpgs fit 'my scene' x x" in said
        assert "..." in said and len(said) < 600 and "choose another folder" in said and notes == []
        assert is_empty(tmp_path)
    assert not list(tmp_path.iterdir())
    monkeypatch.setattr(sys, "argv", ["/lib/warpgs/__main__.py", "eval"])
    with hold_folder(tmp_path):
        assert "`warpgs eval`" in refusal(tmp_path)
    with hold_folder(tmp_path):
        for signature in (b"[" * 100_000, b"\xff"):
            (tmp_path / LOCK).write_bytes(b"\n" + signature)
            assert "is writing there" in refusal(tmp_path) and len(refusal(tmp_path)) < 3000
        (tmp_path / LOCK).write_bytes(b"\n")
        assert refusal(tmp_path).startswith(f"{tmp_path}: another process is writing there")
    (tmp_path / "made.ply").mkdir()
    (tmp_path / "file").touch()
    for name in ("made.ply", f"{'ü' * 126}.ply"):  # of 256 bytes
        with pytest.raises(UsageError, match="is a folder, or the name is too long; give"), hold_file(tmp_path / name):
            pytest.fail("held")
    for name in ("x" * 300, "file/below"):
        with pytest.raises(ResourceError, match="choose another folder"), hold_folder(tmp_path / name):
            pytest.fail("held")


def test_two_files_of_a_folder_are_written_at_once(tmp_path):
    """The same file is refused, also one of a folder that is held; what a killed writer of a file left is swept."""
    one, two = tmp_path / "new" / "a.ply", tmp_path / "new" / "b.ply"
    with hold_file(one), hold_file(two) as notes:
        assert notes == [] and is_empty(one.parent)
        with pytest.raises(ResourceError, match="is writing there"), hold_file(one):
            pytest.fail("held twice")
        left = [p.read_bytes() for p in one.parent.iterdir()]
    assert len(left) == 2 and not list(one.parent.iterdir())
    (one.parent / f"{LEFT}.lock").write_bytes(left[0])
    with hold_folder(one.parent):
        assert [p.name for p in one.parent.iterdir()] == [LOCK]
        with pytest.raises(ResourceError, match="is writing there"), hold_file(two):
            pytest.fail("held twice")


def test_a_sweep_does_not_refuse_a_file(tmp_path, monkeypatch):
    """Another process finds the new lock before it is locked here: it holds it for a moment, and removes it."""
    lock, calls = folders.lock_descriptor, []

    def late(descriptor, blocking):
        calls.append(descriptor)
        if len(calls) == 1:
            next(tmp_path.glob("*.lock")).unlink()
        return len(calls) > 1 and lock(descriptor, blocking=blocking)

    monkeypatch.setattr(folders, "lock_descriptor", late)
    with hold_file(tmp_path / "a.ply"):
        assert len(calls) == 4 and len(list(tmp_path.iterdir())) == 1  # the last call is the own sweep


def test_a_lock_file_alone_holds_nothing(tmp_path):
    """Its process is gone, and the number may be that of another one now, or come from another container."""
    (tmp_path / LOCK).write_text(f'\n{{"process": {os.getpid()}, "host": "", "since": "", "command": ""}}')
    (tmp_path / LEFT).write_text("half a file")
    (tmp_path / "renders").mkdir()
    (tmp_path / "renders" / LEFT).write_text("half an image")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / LEFT).write_text("of another holder")
    with hold_folder(tmp_path, "renders", "depth"):
        assert sorted(p.name for p in tmp_path.rglob("*")) == sorted([LOCK, "renders", "other", LEFT])
    assert not (tmp_path / LOCK).exists()
    # after an error only a folder that was made here, with nothing in it, is removed again
    base, own = tmp_path / "base", tmp_path / "base" / "own"
    own.mkdir(parents=True)
    for folder in (own, base / "made"):
        with pytest.raises(ValueError, match="of the body"), hold_folder(folder):
            raise ValueError("of the body")
    with pytest.raises(ValueError, match="of the body"), hold_folder(base / "filled"):
        (base / "filled" / "result").write_text("kept")
        raise ValueError("of the body")
    assert sorted(p.name for p in base.iterdir()) == ["filled", "own"]


def test_a_lock_that_was_removed_meanwhile_is_taken_anew(tmp_path, monkeypatch):
    """The last holder ends between our opening and our locking: what we have locked then is no longer in the folder."""
    lock, calls = folders.lock_descriptor, []

    def late(descriptor, blocking):
        calls.append(descriptor)
        if len(calls) == 1:
            (tmp_path / LOCK).unlink()
        return lock(descriptor, blocking=blocking)

    monkeypatch.setattr(folders, "lock_descriptor", late)
    with hold_folder(tmp_path):
        assert len(calls) == 2 and (tmp_path / LOCK).is_file()
        assert str(os.getpid()) in refusal(tmp_path)

    # where a file system has no locks the work goes on, and nothing is removed that may be another's
    def refuse(descriptor, blocking):
        raise OSError(errno.ENOSYS, "Function not implemented")

    monkeypatch.setattr(folders, "lock_descriptor", refuse)
    (tmp_path / LEFT).write_text("perhaps being written")
    with hold_folder(tmp_path) as notes:
        assert len(notes) == 1 and "has no locks" in notes[0] and str(tmp_path) in notes[0]
    assert (tmp_path / LEFT).is_file()


@pytest.mark.fault
def test_a_killed_holder_gives_the_folder_free(tmp_path):
    """As soon as it is gone, whatever it left."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", HOLD, str(tmp_path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stdout.readline() == "held\n"
        assert f"process {process.pid} on" in refusal(tmp_path)
        process.kill()
        process.wait()
        assert (tmp_path / LOCK).is_file()
        with hold_folder(tmp_path):
            assert str(os.getpid()) in refusal(tmp_path)
