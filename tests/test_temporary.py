"""Temporary files and folders: what a process holds stays, what a killed one left goes with the next command."""

import os
import subprocess
import sys
import tempfile

import pytest

from warpgs import folders
from warpgs.files import filling, remove_leftovers, replacing
from warpgs.folders import (
    NAMES,
    TemporaryFile,
    TemporaryFolder,
    open_folder,
    shared_locks,
    sweep,
    system_folder,
    temporary_folder,
)
from warpgs.locks import hold_folder

HOLDS = """
import sys
from pathlib import Path
from warpgs.files import filling, replacing
from warpgs.folders import temporary_folder
with temporary_folder(), filling(Path(sys.argv[1]) / "scene") as folder, replacing(Path(sys.argv[1]) / "a.ply") as file:
    (folder / "photo.jpg").touch()
    file.touch()
    print("holds", flush=True)
    sys.stdin.read()
"""
ORPHAN = """
import subprocess, sys
from warpgs.folders import shared_locks, temporary_folder
folder = temporary_folder()
with shared_locks() as locks:
    child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=sys.stdin, pass_fds=locks)
    print("started", flush=True)
    child.wait()
"""


@pytest.fixture
def places(tmp_path, monkeypatch):
    """A folder of results, and one for temporary files."""
    for name in ("X", "tmp"):
        (tmp_path / name).mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "tmp"))
    monkeypatch.setattr(tempfile, "tempdir", None)
    folders.sweep_temporary_files.cache_clear()
    yield tmp_path / "X", tmp_path / "tmp"
    folders.sweep_temporary_files.cache_clear()


def started(code, *words):
    """Start Python, and wait for its first line."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    words = [sys.executable, "-c", code, *map(str, words)]
    process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment)
    assert process.stdout.readline()
    return process


def test_another_command_leaves_what_is_held_and_removes_what_a_killed_one_left(places):
    """As `export --to X/a.ply` beside `poses --out X/scene`: files and folders, beside results and of the system."""
    results, system = places
    process = started(HOLDS, results)
    there = {p.name for p in results.iterdir()}, {p.name for p in system.iterdir()}
    assert [len(t) for t in there] == [3, 2] and all(map(NAMES.fullmatch, there[0] | there[1]))
    with hold_folder(results), temporary_folder():
        now = {p.name for p in results.iterdir()}, {p.name for p in system.iterdir()}
    assert now[0] >= there[0] and now[1] >= there[1]
    process.kill()
    process.communicate()
    folders.sweep_temporary_files.cache_clear()  # of another process
    with hold_folder(results):
        pass
    assert not list(results.iterdir()) and not list(system.iterdir())


def test_a_folder_is_held_until_the_last_process_in_it_has_ended(places):
    """A child that works in it may outlive its parent for a moment."""
    _, system = places
    read, write = os.pipe()
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen([sys.executable, "-c", ORPHAN], stdin=read, stdout=subprocess.PIPE, env=environment) as process:
        process.stdout.readline()
        process.kill()
    (lock,) = system.glob("*.lock")
    with open_folder(system) as folder:
        sweep(folder)
        assert lock.exists() and len(list(system.iterdir())) == 2
        os.close(read)
        os.close(write)
        with lock.open("r+b") as file:
            folders.lock_descriptor(file.fileno())  # waits for it
        sweep(folder)
    assert not list(system.iterdir())


def test_only_own_names_are_swept(tmp_path):
    """Not what looks like it, nor through a link; a name of ours that is a link goes itself."""
    hexes = "0123456789abcdef"
    (tmp_path / "kept").mkdir()
    (tmp_path / "kept" / "file").touch()
    for name in (f"warpgs-{hexes}", f"warpgs-{hexes}.txt", f".warpgs-{hexes[1:]}.tmp", "warpgs-error-x.txt"):
        (tmp_path / name).mkdir()
    kept = {p.name for p in tmp_path.iterdir()}
    (tmp_path / f".warpgs-{hexes}.tmp" / "below").mkdir(parents=True)
    (tmp_path / f"warpgs-{hexes}.tmp.mp4").touch()
    (tmp_path / f"warpgs-{hexes}.tmp.lock").touch()
    (tmp_path / f"warpgs-{hexes}.tmp").symlink_to("kept", target_is_directory=True)
    with open_folder(tmp_path) as folder:
        sweep(folder)
    assert {p.name for p in tmp_path.iterdir()} == kept and (tmp_path / "kept" / "file").exists()


@pytest.mark.skipif(not hasattr(os, "getuid") or os.getuid() != 0, reason="only root can give files to another user")
def test_what_another_user_has_in_the_system_s_folder_stays(tmp_path):
    names = "warpgs-0123456789abcdef.tmp", "warpgs-0123456789abcdee.tmp"
    for name, user in zip(names, (0, 12345)):
        (tmp_path / name).mkdir()
        os.chown(tmp_path / name, user, -1)
    with open_folder(tmp_path) as folder:
        sweep(folder, own=True)
    assert [p.name for p in tmp_path.iterdir()] == [names[1]]


@pytest.mark.parametrize("late", ["locks first", "removes first"])
def test_a_sweep_between_making_and_locking_costs_a_name(tmp_path, monkeypatch, late):
    """The maker sees that its file was taken for a leftover, and makes another one."""
    lock, calls = folders.lock_descriptor, []

    def raced(descriptor, blocking):
        calls.append(descriptor)
        if len(calls) == 1:
            if late == "locks first":
                return False
            (left,) = tmp_path.iterdir()
            left.unlink()
        return lock(descriptor, blocking=blocking)

    monkeypatch.setattr(folders, "lock_descriptor", raced)
    with open_folder(tmp_path) as folder, TemporaryFile(folder) as file:
        assert len(calls) == 2 and (tmp_path / file.name).exists()


def test_a_temporary_folder_is_private_and_goes_with_its_lock(places):
    _, system = places
    with shared_locks() as locks:
        before = len(locks)
    with temporary_folder() as folder:
        assert folder.path.parent == system.resolve() and (os.name == "nt" or folder.path.stat().st_mode & 0o777 == 0o700)
        (folder.path / "file").touch()
        with shared_locks() as locks:
            assert len(locks) == before + (os.name != "nt")
        folder.remove()
        assert not list(system.iterdir())
    with shared_locks() as locks:
        assert len(locks) == before


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
def test_a_forked_child_leaves_the_folder_to_its_parent(places):
    with temporary_folder() as folder:
        child = os.fork()
        if not child:
            folder.remove()
            os._exit(0)
        os.waitpid(child, 0)
        assert folder.path.is_dir()


def test_leftovers_in_a_folder_that_is_made_anew_go(tmp_path):
    (tmp_path / "a").mkdir()
    with open_folder(tmp_path / "a") as above:
        left = TemporaryFolder(above)
        with pytest.raises(Exception, match="cannot be created"), filling(tmp_path / "a"):
            pass  # another process works in it
        with replacing(tmp_path / "a" / "b") as file:
            file.touch()
            remove_leftovers(tmp_path / "a")
        assert (tmp_path / "a" / "b").exists() and left.path.is_dir()


@pytest.mark.skipif(os.name == "nt", reason="Windows keeps Python's own choice")
def test_the_system_s_folder_is_found_without_writing(tmp_path, monkeypatch):
    """Python's own search writes a file, which a command that is killed at that moment leaves behind."""
    named = tmp_path / "named"
    named.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setattr(tempfile, "_get_default_tempdir", lambda *_: pytest.fail("it searched"))
    monkeypatch.setenv("TMPDIR", str(tmp_path / "missing"))
    monkeypatch.setenv("TEMP", str(named))
    assert system_folder() == named.resolve() and tempfile.gettempdir() == str(named)
