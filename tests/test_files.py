"""Files and folders: read with bounds, written whole or not at all, no link followed, nothing left behind."""

import ast
import errno
import os
import socket
import sqlite3
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

import pytest

from warpgs import files, folders
from warpgs.errors import DataError, ResourceError, UsageError
from warpgs.files import (
    LOCK,
    appending,
    disk_is_full,
    filling,
    input_digest,
    is_empty,
    make_folder,
    move_folder,
    open_input,
    read_file,
    read_input,
    read_start,
    remove_file,
    remove_leftovers,
    replacing,
    write_bytes,
)
from warpgs.folders import NAMES as OWN_NAMES
from warpgs.locks import hold_folder
from warpgs.poses import mapping
from warpgs.process import ProcessFailed

ROOT = Path(__file__).parent.parent
LEFT = ".warpgs-0123456789abcdef.tmp"


def full(*_, **__):
    raise OSError(errno.ENOSPC, "No space left on device")


def test_order_of_a_replacement(tmp_path, monkeypatch):
    """Synced, read back, put in place, and then the folder is synced, too."""
    path, order = tmp_path / "a.png", []
    fsync, replace = os.fsync, os.replace

    def synced(descriptor):
        order.append("folder" if os.path.isdir(f"/proc/self/fd/{descriptor}") else "file")
        fsync(descriptor)

    monkeypatch.setattr(files.os, "fsync", synced)
    monkeypatch.setattr(files.os, "replace", lambda *a, **at: order.append("replace") or replace(*a, **at))
    with replacing(path, lambda p: order.append(p.read_bytes())) as (_, temporary):
        assert OWN_NAMES.fullmatch(temporary.name) and temporary.parent.samefile(tmp_path)
        temporary.write_bytes(b"new")
    assert path.read_bytes() == b"new" and order[1:3] == [b"new", "replace"]
    assert len(order) == (3 if files.WINDOWS else 4)


@pytest.mark.parametrize("failing", ["write", "check", "os.fsync", "os.replace"])
@pytest.mark.parametrize("stuck", [False, True])
def test_whatever_fails_the_old_file_stays_and_the_error_is_its_own(tmp_path, monkeypatch, failing, stuck):
    """Also where the temporary file cannot even be removed: it has a name that is known, and goes with the next holder."""
    path = tmp_path / "a.json"
    path.write_bytes(b"old")
    if failing.startswith("os."):
        monkeypatch.setattr(files.os, failing[3:], full)
    if stuck:
        monkeypatch.setattr(os, "unlink", full)
    with pytest.raises(ResourceError, match=r"a\.json: cannot be written \(No space left.* is untouched"):
        with replacing(path, full if failing == "check" else None) as (_, temporary):
            temporary.write_bytes(b"new")
            if failing == "write":
                full()
    monkeypatch.undo()
    assert path.read_bytes() == b"old" and len(list(tmp_path.iterdir())) == 1 + stuck
    remove_leftovers(tmp_path)
    assert list(tmp_path.iterdir()) == [path]


def test_a_short_file_or_a_failed_check_leaves_the_old_one(tmp_path, monkeypatch):
    """Some file systems report no error: then the size tells. The error of a check is its own."""

    def refuse(_):
        raise DataError("no film")

    with pytest.raises(DataError, match="no film"), replacing(tmp_path / "a", refuse) as (_, temporary):
        temporary.write_bytes(b"new")
    assert not list(tmp_path.iterdir())
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")
    monkeypatch.setattr(files.os, "fsync", lambda descriptor: os.truncate(descriptor, 2))
    with pytest.raises(ResourceError, match=r"3 bytes cannot be written.*2 of 3 bytes"):
        write_bytes(path, b"new")
    assert path.read_bytes() == b"old"


def test_windows_replaces_no_open_file(tmp_path, monkeypatch):
    path = tmp_path / "a.png"

    def in_use(*names, **at):
        raise PermissionError(errno.EACCES, "in use")

    monkeypatch.setattr(files, "WINDOWS", True)
    monkeypatch.setattr(files.os, "replace", in_use)
    with pytest.raises(ResourceError, match="close the programs that have it open"):
        write_bytes(path, b"newer")


@pytest.mark.skipif(files.WINDOWS, reason="Windows syncs no folders")
def test_a_folder_that_cannot_be_synced(tmp_path, monkeypatch):
    """A file system that has no such call is passed over; a disk that fails is said, and the new file is there."""
    fsync, errors = os.fsync, [errno.EINVAL, errno.EIO]

    def some(descriptor):
        if os.path.isdir(f"/proc/self/fd/{descriptor}") or not os.path.isfile(f"/proc/self/fd/{descriptor}"):
            raise OSError(errors[0], "no")
        fsync(descriptor)

    monkeypatch.setattr(files.os, "fsync", some)
    write_bytes(tmp_path / "a", b"1")
    errors.pop(0)
    with pytest.raises(ResourceError, match="does not confirm"):
        write_bytes(tmp_path / "a", b"2")
    assert (tmp_path / "a").read_bytes() == b"2"


def test_only_own_names_are_leftovers_and_are_swept(tmp_path):
    """Not what looks like it, nor through a link; a name of ours that is a link goes itself."""
    assert is_empty(tmp_path)
    for name in (LOCK, LEFT, LEFT + ".mp4"):
        (tmp_path / name).touch()
    assert is_empty(tmp_path)
    for name in ("a.tmp", LEFT + ".png", "x" + LEFT, ".hidden"):
        (tmp_path / name).touch()
        assert not is_empty(tmp_path), name
        (tmp_path / name).unlink()
    with pytest.raises(ResourceError, match="cannot be read"):
        is_empty(tmp_path / "none")
    for name in (LOCK, LEFT, LEFT + ".mp4"):
        (tmp_path / name).unlink()
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
    remove_leftovers(tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == kept and (tmp_path / "kept" / "file").exists()


def test_a_folder_appears_whole_or_not_at_all(tmp_path, monkeypatch):
    """Also in the place of an empty one; an error of the block goes on, and one of the disk says what to do."""
    assert make_folder(tmp_path / "a") and not make_folder(tmp_path / "a")
    (tmp_path / "a" / LEFT).touch()
    for name in (f"a/{LEFT}", f"a/{LEFT}/below", "x" * 300):
        with pytest.raises(ResourceError, match="cannot be created"):
            make_folder(tmp_path / name)
    for name in ("a", "b/c"):
        with filling(tmp_path / name) as temporary:
            assert OWN_NAMES.fullmatch(temporary.name) and temporary.parent == (tmp_path / name).parent
            (temporary / "x").touch()
        assert [p.name for p in (tmp_path / name).iterdir()] == ["x"] and not temporary.exists()
    with folders.open_folder(tmp_path / "a") as above, folders.Temporary(above) as held:  # another process works in it
        above.mkdir(held.name)
        with pytest.raises(ResourceError, match="cannot be created"), filling(tmp_path / "a"):
            pass
        assert held.path.is_dir()
    with pytest.raises(KeyboardInterrupt), filling(tmp_path / "d") as temporary:
        (temporary / "x").touch()
        raise KeyboardInterrupt
    monkeypatch.chdir(tmp_path / "b")
    with pytest.raises(UsageError, match="refusing to replace the current directory"), filling(Path(".")):
        pass
    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(ResourceError, match="d: cannot be created"), filling(tmp_path / "d"):
        pass
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "b"]


WRITERS = {
    "write_text", "write_bytes", "touch", "imwrite", "VideoWriter", "save", "save_file", "savez", "savez_compressed", "savetxt",
    "tofile", "screenshot", "imsave", "mimsave", "write_video", "dump", "NamedTemporaryFile", "mkstemp", "copyfile",
    "copytree", "copy2",
}  # fmt: skip
"""Functions of other modules that write to a path they are given."""
ELSEWHERE = {
    ("app/cli.py", "NamedTemporaryFile"): "details of a defect, in the folder for temporary files",
    ("process.py", "open wb"): "the null device",
    ("report/film.py", "VideoWriter"): "into the temporary file of `replacing`, which decodes it",
    ("poses/matching.py", "savez"): "into the file of `replacing`",
    ("report/film.py", "save"): "the same",
    ("export/sog.py", "save"): "the same",
    ("export/meshes_and_cameras.py", "save"): "the same",
    ("poses/photographs.py", "save"): "the same",
    ("folders.py", "open wb"): "the temporary file of `replacing`",
    ("files.py", "open ab"): "a file that grows by lines: metrics.jsonl, the log of a job",
    ("folders.py", "os.open"): "folders and files by descriptor, for the functions of `warpgs.files`",
    ("files.py", "os.open"): "files by descriptor, to read",
    ("pipeline/farm/worker.py", "open w"): "a copy of stdout",
    ("kernels/native.py", "open ab"): "a lock beside compiled kernels",
    ("locks.py", "open r+b"): "the lock of a folder",
    ("process.py", "os.open"): "the null device; a folder or a file, to read it",
}
"""Every other way of writing in the package, and what is written there: no result of the user's."""


def writers(tree: ast.AST) -> set[str]:
    found = set()
    for node in (n for n in ast.walk(tree) if isinstance(n, ast.Call)):
        name = ast.unparse(node.func)
        last = name.rpartition(".")[2]
        words = [a.value for a in [*node.args, *(k.value for k in node.keywords)] if isinstance(a, ast.Constant)]
        modes = [w for w in words if isinstance(w, str) and set(w) <= set("rwxabt+") and set(w) & set("wxa+")]
        if name == "os.open":
            found.add(name)
        elif last in ("open", "fdopen") and modes:
            found.add(f"open {modes[0]}")
        elif "." in name and last in WRITERS and name != f"files.{last}":
            found.add(last)
    return found


def test_nothing_writes_past_the_one_way():
    """Whatever writes a file is `warpgs.files`, or is listed above with its reason; the list is true, and writers are seen."""
    found = set()
    for path in sorted((ROOT / "warpgs").rglob("*.py")):
        name = path.relative_to(ROOT / "warpgs").as_posix()
        found |= {(name, call) for call in writers(ast.parse(path.read_text("utf-8")))}
    assert found - ELSEWHERE.keys() == set(), "write it with warpgs.files"
    assert ELSEWHERE.keys() - found == set(), "no longer there"
    for code in ("open(p, 'w')", "p.write_text('')", "cv2.imwrite(p, i)", "os.open(p, 1)", "open(p, mode='r+b')"):
        assert writers(ast.parse(code)), code
    assert not writers(ast.parse("open(p); p.open('rb'); write_bytes(p, b''); os.replace(a, b); Image.open(p); model.load(p)"))


# One function opens every input file: pipes, devices and folders are refused before a byte is read; sizes are bounded.


def special(kind, path):
    """Make a file of a kind that is no regular one, or skip where the system has none."""
    if os.name == "nt":
        pytest.skip("Windows has no such files")
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as s:
            s.bind(str(path))
    elif kind == "folder":
        path.mkdir()
    elif kind == "unreadable":
        path.symlink_to(path)  # a link to itself: what even root cannot open
    else:
        path.write_bytes(b"")
    return path


@pytest.mark.parametrize("kind, words", [
    ("pipe", "is not a regular file"), ("device", "is not a regular file"), ("socket", "is not a regular file"),
    ("folder", "is a folder"), ("unreadable", "symbolic links"),
])  # fmt: skip
def test_what_is_no_regular_file_is_refused(kind, words, tmp_path, monkeypatch):
    path = special(kind, tmp_path / "x")
    for read in (open_input, read_input, lambda p: read_start(p, 4)):
        with pytest.raises(OSError) as e:
            read(path)
        assert words in e.value.strerror and str(tmp_path) in str(e.value)
    with pytest.raises(DataError, match=f"cannot be read .*{words}.*; mend it"):
        read_file(path, fix="mend it")
    with pytest.raises(DataError, match=f"cannot be read .*{words}"):
        input_digest(path)
    if kind == "pipe":  # that takes the place of a file: it does not block
        (tmp_path / "f").touch()
        ordinary = os.stat(tmp_path / "f")
        monkeypatch.setattr(files.os, "stat", lambda path: ordinary)
        with pytest.raises(OSError, match="is not a regular file"):
            open_input(path)


def test_sizes_are_bounded_before_and_while_reading(tmp_path, monkeypatch):
    path = tmp_path / "f"
    path.write_bytes(b"12345678")
    assert read_input(path, 8) == b"12345678" and read_start(path, 3) == b"123"
    with open_input(path) as file:
        assert (os.name == "nt" or os.get_blocking(file.fileno())) and not os.get_inheritable(file.fileno())
    open_files = len(os.listdir("/proc/self/fd")) if Path("/proc/self/fd").exists() else 0
    with pytest.raises(OSError):
        open_input(tmp_path)
    assert not open_files or open_files == len(os.listdir("/proc/self/fd"))
    with pytest.raises(OSError, match="larger than 7 bytes"):
        read_input(path, 7)
    with path.open("wb") as f:
        f.truncate(2**40)  # a hole: takes no disk
    with pytest.raises(OSError, match="larger than 16,384 MiB"):
        read_input(path)
    if Path("/proc/self/status").exists():  # Linux has files without a size
        assert b"VmPeak" in read_input("/proc/self/status")
        with pytest.raises(OSError, match="larger than 10 bytes"):
            read_input("/proc/self/status", 10)


# Below a folder of results no link is followed, neither to write nor to read; the folder itself may be a link.

with_links = pytest.mark.skipif(os.name == "nt", reason="links need a right that users of Windows often lack")


def _replace(path):
    with replacing(path) as (_, temporary):
        temporary.write_bytes(b"new")


def _fill(path):
    with filling(path) as temporary:
        (temporary / "x").touch()


WAYS = {
    "write": lambda p: write_bytes(p / "canary", b"new"),
    "replace": lambda p: _replace(p / "canary"),
    "append": lambda p: appending(p / "canary").close(),
    "make": lambda p: make_folder(p / "below"),
    "fill": lambda p: _fill(p / "below"),
    "remove": lambda p: remove_file(p / "canary"),
    "move": lambda p: move_folder(p / "folder", "moved"),
    "read": lambda p: open_input(p / "canary", p).close(),
}


@pytest.fixture
def outside(tmp_path):
    """A folder elsewhere whose contents must stay."""
    outside = tmp_path / "outside"
    (outside / "folder").mkdir(parents=True)
    (outside / "canary").write_bytes(b"old")
    yield outside
    assert sorted(p.name for p in outside.iterdir()) == ["canary", "folder"]
    assert (outside / "canary").read_bytes() == b"old"


@with_links
@pytest.mark.parametrize("depth", [1, 3])
@pytest.mark.parametrize("way", WAYS)
def test_a_folder_that_is_a_link_is_refused(tmp_path, outside, way, depth):
    """At every depth below the folder that was opened, with an error that names the link."""
    root = tmp_path / "results"
    at = root.joinpath(*"abc"[:depth])
    at.parent.mkdir(parents=True)
    at.symlink_to(outside)
    with folders.output_folder(root), pytest.raises((ResourceError, folders.RefusedError), match=f"{at}: is a link"):
        WAYS[way](at)


@with_links
def test_the_folder_itself_may_be_a_link(tmp_path):
    """As may folders above it: people keep results on another disk."""
    real = tmp_path / "disk" / "results"
    (real / "folder").mkdir(parents=True)
    (real / "canary").write_bytes(b"old")
    (tmp_path / "home").symlink_to(tmp_path / "disk")
    (tmp_path / "disk" / "link").symlink_to(real)
    with folders.output_folder(tmp_path / "home" / "link"):
        for way in WAYS.values():
            (real / "canary").write_bytes(b"old")
            way(tmp_path / "home" / "link")


@with_links
def test_a_file_that_is_a_link_is_replaced_and_never_followed(tmp_path, outside):
    """A write takes the place of the name; what would be appended to or read is refused, as is a pipe, without waiting."""
    root = tmp_path / "results"
    root.mkdir()
    link = root / "link"
    with folders.output_folder(root):
        for write in (lambda: write_bytes(link, b"new"), lambda: _replace(link)):
            link.symlink_to(outside / "canary")
            write()
            assert not link.is_symlink() and link.read_bytes() == b"new"
            link.unlink()
        for target in (outside / "canary", outside / "new", outside):
            link.symlink_to(target)
            for refused in (appending, lambda p: open_input(p, root)):
                with pytest.raises(folders.RefusedError, match="is a link inside of a results folder"):
                    refused(link)
            with pytest.raises(ResourceError, match="link: is a link inside of a results folder"), filling(link):
                pass
            remove_file(link)
            assert not link.is_symlink()
        os.mkfifo(link)
        with pytest.raises(folders.RefusedError, match="not a regular file"):
            open_input(link, root)
        with pytest.raises(OSError):
            appending(link)
    with pytest.raises(OSError, match="not a regular file"):
        open_input(link)
    # a file that the user names may be a link; one of a run that nobody opened, or behind a folder of it, may not
    (root / "folder").symlink_to(outside)
    (root / "file").symlink_to(outside / "canary")
    assert open_input(root / "file").read() == b"old"
    for path in (root / "file", root / "folder" / "canary"):
        with pytest.raises(folders.RefusedError, match="is a link"):
            open_input(path, root)
    with pytest.raises(FileNotFoundError):
        open_input(root / "none" / "x", root)


@with_links
def test_a_folder_that_was_replaced_is_not_written(tmp_path):
    """Neither the one that took its place nor, once that is gone, another; at its own place again it is."""
    root, inner = tmp_path / "results", tmp_path / "results" / "a"
    inner.mkdir(parents=True)
    with folders.output_folder(root), folders.output_folder(inner):
        for folder in (root, inner):
            moved = tmp_path / "moved"
            folder.rename(moved)
            with pytest.raises(ResourceError, match=f"{folder}: the folder was moved|a: cannot be written|No such file"):
                write_bytes(inner / "x", b"")
            (root / "a").mkdir(parents=True)
            with pytest.raises(ResourceError, match=f"{folder}: the folder was moved"):
                write_bytes(inner / "x", b"")
            assert not (inner / "x").exists()
            inner.rmdir()
            if folder is root:
                root.rmdir()
            moved.rename(folder)
        write_bytes(inner / "x", b"1")
    assert (inner / "x").read_bytes() == b"1"


@with_links
def test_folders_are_closed(tmp_path):
    """No descriptor is left behind, be there an error or not, and another thread may hold the same folder."""
    descriptors = "/proc/self/fd" if os.path.isdir("/proc/self/fd") else "/dev/fd"
    (tmp_path / "link").symlink_to(tmp_path)
    before = len(os.listdir(descriptors))
    with folders.output_folder(tmp_path):
        with folders.output_folder(tmp_path):
            write_bytes(tmp_path / "a", b"1")
            with pytest.raises(ResourceError):
                make_folder(tmp_path / "link" / "b")
            with pytest.raises(folders.RefusedError):
                folders.open_folder(tmp_path / "link")
            with pytest.raises(ResourceError, match="use a path without"):
                write_bytes(tmp_path / ".." / "x", b"")
        thread = threading.Thread(target=write_bytes, args=(tmp_path / "b", b"2"))
        thread.start()
        thread.join()
    assert len(os.listdir(descriptors)) == before and (tmp_path / "b").read_bytes() == b"2"


# Temporary files and folders: what a process holds stays, what a killed one left goes with the next command.

HOLDS = """
import sys
from pathlib import Path
from warpgs.files import filling, replacing
from warpgs.folders import temporary_folder
with temporary_folder(), filling(Path(sys.argv[1]) / "scene") as folder, replacing(Path(sys.argv[1]) / "a.ply") as (_, file):
    (folder / "photo.jpg").touch()
    file.touch()
    print("holds", flush=True)
    sys.stdin.read()
"""
ORPHAN = """
import subprocess, sys
from warpgs.folders import shared_locks, temporary_folder
with temporary_folder(), shared_locks() as locks:
    child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=sys.stdin, pass_fds=locks)
    print("started", flush=True)
    child.wait()
"""


@pytest.fixture
def places(tmp_path, monkeypatch):
    for name in ("X", "tmp"):
        (tmp_path / name).mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "tmp"))
    monkeypatch.setattr(tempfile, "tempdir", None)
    folders.sweep_temporary_files.cache_clear()
    yield tmp_path / "X", tmp_path / "tmp"
    folders.sweep_temporary_files.cache_clear()


def started(code, *words, stdin=subprocess.PIPE):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    words = [sys.executable, "-c", code, *map(str, words)]
    process = subprocess.Popen(words, stdin=stdin, stdout=subprocess.PIPE, text=True, env=environment)
    assert process.stdout.readline()
    return process


def test_another_command_leaves_what_is_held_and_removes_what_a_killed_one_left(places):
    """As `export --to X/a.ply` beside `poses --out X/scene`: files and folders, beside results and of the system."""
    results, system = places
    process = started(HOLDS, results)
    there = {p.name for p in results.iterdir()}, {p.name for p in system.iterdir()}
    assert [len(t) for t in there] == [3, 2] and all(map(folders.NAMES.fullmatch, there[0] | there[1]))
    with hold_folder(results), folders.temporary_folder():
        now = {p.name for p in results.iterdir()}, {p.name for p in system.iterdir()}
    assert now[0] >= there[0] and now[1] >= there[1]
    process.kill()
    process.communicate()
    folders.sweep_temporary_files.cache_clear()  # of another process
    with hold_folder(results):
        pass
    assert not list(results.iterdir()) and not list(system.iterdir())
    # a child that works in a folder may outlive its parent for a moment: it is held until the last process has ended
    _, system = places
    read, write = os.pipe()
    with started(ORPHAN, stdin=read) as process:
        process.kill()
    (lock,) = system.glob("*.lock")
    with folders.open_folder(system) as folder:
        folders.sweep(folder)
        assert lock.exists() and len(list(system.iterdir())) == 2
        os.close(read)
        os.close(write)
        with lock.open("r+b") as file:
            folders.lock_descriptor(file.fileno())  # waits for it
        folders.sweep(folder)
    assert not list(system.iterdir())


@pytest.mark.skipif(not hasattr(os, "getuid") or os.getuid() != 0, reason="only root can give files to another user")
def test_what_another_user_has_in_the_system_s_folder_stays(tmp_path):
    names = "warpgs-0123456789abcdef.tmp", "warpgs-0123456789abcdee.tmp"
    for name, user in zip(names, (0, 12345)):
        (tmp_path / name).mkdir()
        os.chown(tmp_path / name, user, -1)
    with folders.open_folder(tmp_path) as folder:
        folders.sweep(folder, own=True)
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
    with folders.open_folder(tmp_path) as folder, folders.Temporary(folder) as held:
        assert len(calls) == 2 and (tmp_path / (held.name + ".lock")).exists()


def test_a_temporary_folder_is_private_and_goes_with_its_lock(places):
    _, system = places
    with folders.shared_locks() as locks:
        before = len(locks)
    with folders.temporary_folder() as folder:
        assert folder.path.parent == system.resolve() and (os.name == "nt" or folder.path.stat().st_mode & 0o777 == 0o700)
        (folder.path / "file").touch()
        with folders.shared_locks() as locks:
            assert len(locks) == before + (os.name != "nt")
        folder.remove()
        assert not list(system.iterdir())
    with folders.shared_locks() as locks:
        assert len(locks) == before
    if hasattr(os, "fork"):  # a child leaves the folder to its parent
        with folders.temporary_folder() as folder:
            child = os.fork()
            if not child:
                folder.remove()
                os._exit(0)
            os.waitpid(child, 0)
            assert folder.path.is_dir()


# A full disk of another process is called that, and neither a lack of memory nor a fault of a renderer.

FULL = f"[Errno {errno.ENOSPC}] {os.strerror(errno.ENOSPC)}"


def test_a_full_disk_is_known_by_words_room_and_renderer(tmp_path, monkeypatch):
    assert disk_is_full(tmp_path, f"OSError: {FULL}: 'a.png'") and not disk_is_full(tmp_path, "Segmentation fault")
    with pytest.raises(sqlite3.OperationalError) as e:
        database = sqlite3.connect(tmp_path / "a.db")
        database.execute("pragma max_page_count = 2")
        database.execute("create table a (x)")
        database.execute("insert into a values (zeroblob(100000))")
    assert disk_is_full(tmp_path, str(e.value))
    monkeypatch.setattr(files, "MIN_FREE", 2**80)
    assert disk_is_full(tmp_path, "") and not disk_is_full(tmp_path / "none", "")


@pytest.mark.parametrize(("said", "words"), [(FULL, "its disk is full"), ("killed", "too little memory")])
def test_poses(tmp_path, monkeypatch, said, words):
    def failing(*_, **__):
        raise ProcessFailed(-6, said)
        yield

    monkeypatch.setattr(mapping, "python_lines", failing)
    work = tmp_path / ".warpgs-0.tmp" / "work"
    work.mkdir(parents=True)
    with pytest.raises(ResourceError, match=words) as e:
        list(mapping._lines({}, work))
    assert (str(e.value).startswith(f"{tmp_path}: ")) == (said == FULL)


@pytest.mark.fault
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="no Linux mount")
@pytest.mark.parametrize("command", ["poses", "plot"])
def test_real_disks(tmp_path, command):
    """A file system in memory that is nearly full holds the results."""
    disk, files = tmp_path / "disk", tmp_path / "files"
    for folder in (disk, files):
        folder.mkdir()
    size = {"poses": "size=1m", "plot": "size=4k"}[command]
    if subprocess.run(["mount", "-t", "tmpfs", "-o", size, "tmpfs", str(disk)], capture_output=True, check=False).returncode:
        pytest.skip("this user cannot mount")
    try:
        program = [sys.executable, "-P", "-m", "warpgs"]
        size = ["--views", "8", "--width", "320", "--height", "240"]
        subprocess.run([*program, "demo", str(files / "scene"), *size], check=True)
        words = ["poses", str(files / "scene" / "images"), "--out", str(disk / "scene")]
        if command == "plot":
            fit = ["fit", str(files / "scene"), "--out", str(files / "run"), "--steps", "2", "--device", "cpu"]
            subprocess.run([*program, *fit, "--preset", "3dgs", "--init.source", "random"], check=True)
            words = ["plot", str(files / "run"), "--out", str(disk / "plot.png"), "--device", "cpu"]
        done = subprocess.run([*program, *words], capture_output=True, text=True, check=False)
        assert done.returncode == 4, done.stderr
        assert "disk" in done.stderr and "memory" not in done.stderr
        assert str(disk) in done.stderr or os.strerror(errno.ENOSPC) in done.stderr
    finally:
        subprocess.run(["umount", "-l", str(disk)], check=True)
