"""A file appears whole or not at all, however its writing ends, and nothing in the package writes any other way."""

import ast
import contextlib
import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from warpgs import files
from warpgs.errors import DataError, ResourceError, UsageError
from warpgs.files import LOCK, OWN_NAMES, filling, is_empty, make_folder, remove_leftovers, replacing, write_bytes

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
    with replacing(path, lambda p: order.append(p.read_bytes())) as temporary:
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
        with replacing(path, full if failing == "check" else None) as temporary:
            temporary.write_bytes(b"new")
            if failing == "write":
                full()
    monkeypatch.undo()
    assert path.read_bytes() == b"old" and len(list(tmp_path.iterdir())) == 1 + stuck
    remove_leftovers(tmp_path)
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_that_comes_out_short_is_not_put_in_place(tmp_path, monkeypatch):
    """Some file systems report no error: then the size tells."""
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")
    monkeypatch.setattr(files.os, "fsync", lambda descriptor: os.truncate(descriptor, 2))
    with pytest.raises(ResourceError, match=r"3 bytes cannot be written.*2 of 3 bytes"):
        write_bytes(path, b"new")
    assert path.read_bytes() == b"old"


def test_errors_of_a_check_are_its_own(tmp_path):
    def refuse(_):
        raise DataError("no film")

    with pytest.raises(DataError, match="no film"), replacing(tmp_path / "a", refuse) as temporary:
        temporary.write_bytes(b"new")
    assert not list(tmp_path.iterdir())


def test_windows_replaces_no_open_file_at_once(tmp_path, monkeypatch):
    """A scanner lets go of it after a moment; a viewer does not, and the message says what to do."""
    path, waits, replace = tmp_path / "a.png", [], os.replace
    path.write_bytes(b"old")

    def refuse(times):
        def in_use(*names, **at):
            if len(waits) < times:
                raise PermissionError(errno.EACCES, "in use")
            replace(*names, **at)

        return in_use

    monkeypatch.setattr(files, "WINDOWS", True)
    monkeypatch.setattr(files.time, "sleep", waits.append)
    monkeypatch.setattr(files.os, "replace", refuse(2))
    write_bytes(path, b"new")
    assert path.read_bytes() == b"new" and waits == list(files.PAUSES[:2])
    monkeypatch.setattr(files.os, "replace", refuse(99))
    with pytest.raises(ResourceError, match="close the programs that have it open"):
        write_bytes(path, b"newer")
    assert path.read_bytes() == b"new" and list(tmp_path.iterdir()) == [path]


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


def test_a_folder_with_nothing_but_our_own_leftovers_is_empty(tmp_path):
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


def test_leftovers_are_files_and_folders_under_our_own_names(tmp_path):
    """A folder that was being filled goes with all in it; a link goes, and not what it leads to."""
    (tmp_path / LEFT).mkdir()
    (tmp_path / LEFT / "config.json").touch()
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "kept").touch()
    with contextlib.suppress(OSError):  # Windows may have no links
        (tmp_path / LEFT.replace("0", "1")).symlink_to("own", target_is_directory=True)
    remove_leftovers(tmp_path)
    assert [p.name for p in tmp_path.rglob("*")] == ["own", "kept"]


def test_a_folder_appears_whole_or_not_at_all(tmp_path, monkeypatch):
    """Also in the place of an empty one; an error of the block goes on, and one of the disk says what to do."""
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / LEFT).touch()
    for name in ("a", "b/c"):
        with filling(tmp_path / name) as temporary:
            assert OWN_NAMES.fullmatch(temporary.name) and temporary.parent == (tmp_path / name).parent
            (temporary / "x").touch()
        assert [p.name for p in (tmp_path / name).iterdir()] == ["x"] and not temporary.exists()
    with pytest.raises(KeyboardInterrupt), filling(tmp_path / "d") as temporary:
        (temporary / "x").touch()
        raise KeyboardInterrupt
    monkeypatch.chdir(tmp_path / "b")
    with pytest.raises(UsageError, match="refusing to replace the current directory"), filling(Path(".")):
        pass
    monkeypatch.setattr(os, "rename", full)
    with pytest.raises(ResourceError, match="d: cannot be created"), filling(tmp_path / "d"):
        pass
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "b"]


def test_a_folder_that_cannot_be_made(tmp_path):
    assert make_folder(tmp_path / "a" / "b") and not make_folder(tmp_path / "a")
    (tmp_path / "file").touch()
    for name in ("file", "file/below", "x" * 300):
        with pytest.raises(ResourceError, match="cannot be created"):
            make_folder(tmp_path / name)


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
    ("report/overview.py", "savez"): "into a temporary folder",
    ("poses/matching.py", "savez"): "into the file of `writing`",
    ("report/images.py", "save"): "Pillow, into memory",
    ("report/film.py", "save"): "the same",
    ("export/sog.py", "save"): "the same",
    ("poses/photographs.py", "save"): "the same",
    ("files.py", "open wb"): "the temporary file of `writing`",
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
    """Calls in a module that write files."""
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
        elif "." in name and last in WRITERS:
            found.add(last)
    return found


def test_nothing_writes_past_the_one_way():
    """Whatever writes a file is `warpgs.files`, or stands in the list above with its reason; and the list is true."""
    found = set()
    for path in sorted((ROOT / "warpgs").rglob("*.py")):
        name = path.relative_to(ROOT / "warpgs").as_posix()
        found |= {(name, call) for call in writers(ast.parse(path.read_text("utf-8")))}
    assert found - ELSEWHERE.keys() == set(), "write it with warpgs.files"
    assert ELSEWHERE.keys() - found == set(), "no longer there"


@pytest.mark.parametrize(
    "code",
    ["open(p, 'w')", "p.open('wb')", "p.write_text('')", "cv2.imwrite(p, i)", "image.save(p)", "np.savez(p)", "os.open(p, 1)",
     "safetensors.torch.save_file(t, p)", "open(p, mode='r+b')", "json.dump(v, f)", "plotter.screenshot(p)"],
)  # fmt: skip
def test_writers_are_seen(code):
    assert writers(ast.parse(code))


def test_readers_are_no_writers():
    assert not writers(ast.parse("open(p); p.open('rb'); write_bytes(p, b''); os.replace(a, b); Image.open(p); model.load(p)"))


@pytest.mark.fault
def test_commands_put_every_file_in_place_as_a_whole(tmp_path):
    """Python's own record of what is opened and renamed: each file that is there at the end was put there under a name of ours.

    That holds for files that libraries in C write past Python, too, as they cannot be there without having been renamed.
    """
    code = (ROOT / "tests" / "audited_commands.py").read_text("utf-8")
    environment = os.environ | {"PYTHONPATH": str(ROOT), "WARPGS_CACHE": str(tmp_path / "cache"), "CUDA_VISIBLE_DEVICES": ""}
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "out")], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.splitlines()[-1] == "every file was put in place as a whole"
