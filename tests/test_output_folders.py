"""Below a folder of results no link is followed, neither to write nor to read; the folder itself may be a link."""

import os
import threading

import pytest

from warpgs.errors import ResourceError
from warpgs.files import appending, filling, make_folder, move_folder, open_input, remove_file, replacing, write_bytes
from warpgs.folders import RefusedError, open_file, open_folder, output_folder

pytestmark = pytest.mark.skipif(os.name == "nt", reason="links need a right that users of Windows often lack")
WAYS = {
    "write": lambda p: write_bytes(p / "canary", b"new"),
    "replace": lambda p: _replace(p / "canary"),
    "append": lambda p: appending(p / "canary").close(),
    "make": lambda p: make_folder(p / "below"),
    "fill": lambda p: _fill(p / "below"),
    "remove": lambda p: remove_file(p / "canary"),
    "move": lambda p: move_folder(p / "folder", "moved"),
    "read": lambda p: open_file(p / "canary", p).close(),
}


def _replace(path):
    with replacing(path) as temporary:
        temporary.write_bytes(b"new")


def _fill(path):
    with filling(path) as temporary:
        (temporary / "x").touch()


@pytest.fixture
def outside(tmp_path):
    """A folder elsewhere whose contents must stay."""
    outside = tmp_path / "outside"
    (outside / "folder").mkdir(parents=True)
    (outside / "canary").write_bytes(b"old")
    yield outside
    assert sorted(p.name for p in outside.iterdir()) == ["canary", "folder"]
    assert (outside / "canary").read_bytes() == b"old"


@pytest.mark.parametrize("depth", [1, 3])
@pytest.mark.parametrize("way", WAYS)
def test_a_folder_that_is_a_link_is_refused(tmp_path, outside, way, depth):
    """At every depth below the folder that was opened, with an error that names the link."""
    root = tmp_path / "results"
    at = root.joinpath(*"abc"[:depth])
    at.parent.mkdir(parents=True)
    at.symlink_to(outside)
    with output_folder(root), pytest.raises((ResourceError, RefusedError), match=f"{at}: is a link"):
        WAYS[way](at)


@pytest.mark.parametrize("way", WAYS)
def test_the_folder_itself_may_be_a_link(tmp_path, way):
    """As may folders above it: people keep results on another disk."""
    real = tmp_path / "disk" / "results"
    (real / "folder").mkdir(parents=True)
    (real / "canary").write_bytes(b"old")
    (tmp_path / "home").symlink_to(tmp_path / "disk")
    (tmp_path / "disk" / "link").symlink_to(real)
    with output_folder(tmp_path / "home" / "link"):
        WAYS[way](tmp_path / "home" / "link")


def test_a_file_that_is_a_link_is_replaced_and_never_followed(tmp_path, outside):
    """A write takes the place of the name; what would be appended to or read is refused, as is a pipe, without waiting."""
    root = tmp_path / "results"
    root.mkdir()
    link = root / "link"
    with output_folder(root):
        for write in (lambda: write_bytes(link, b"new"), lambda: _replace(link)):
            link.symlink_to(outside / "canary")
            write()
            assert not link.is_symlink() and link.read_bytes() == b"new"
            link.unlink()
        for target in (outside / "canary", outside / "new", outside):
            link.symlink_to(target)
            for refused in (appending, lambda p: open_file(p, root)):
                with pytest.raises(RefusedError, match="is a link, and links inside"):
                    refused(link)
            with pytest.raises(ResourceError, match="link: is a link, and links inside"), filling(link):
                pass
            remove_file(link)
            assert not link.is_symlink()
        os.mkfifo(link)
        with pytest.raises(RefusedError, match="not a regular file"):
            open_file(link, root)
        with pytest.raises(OSError):
            appending(link)
    with pytest.raises(OSError, match="not a regular file"):
        open_input(link)


def test_reading_below_a_folder_that_nobody_opened(tmp_path, outside):
    """A file that the user names may be a link; one of a run, or behind a folder of it, may not."""
    run = tmp_path / "run"
    run.mkdir()
    (run / "link").symlink_to(outside)
    (run / "file").symlink_to(outside / "canary")
    assert open_input(run / "file").read() == b"old"
    for path in (run / "file", run / "link" / "canary"):
        with pytest.raises(RefusedError, match="is a link"):
            open_input(path, run)
    with pytest.raises(FileNotFoundError):
        open_input(run / "none" / "x", run)


def test_a_folder_that_was_replaced_is_not_written(tmp_path):
    """Neither the one that took its place nor, once that is gone, another; at its own place again it is."""
    root, inner = tmp_path / "results", tmp_path / "results" / "a"
    inner.mkdir(parents=True)
    with output_folder(root), output_folder(inner):
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


def test_a_name_that_leads_out_is_refused(tmp_path):
    root = tmp_path / "results"
    root.mkdir()
    with output_folder(root), pytest.raises(ResourceError, match="use a path without"):
        write_bytes(root / ".." / "x", b"")


def test_folders_are_closed(tmp_path):
    """No descriptor is left behind, be there an error or not, and another thread may hold the same folder."""
    descriptors = "/proc/self/fd" if os.path.isdir("/proc/self/fd") else "/dev/fd"
    (tmp_path / "link").symlink_to(tmp_path)
    before = len(os.listdir(descriptors))
    with output_folder(tmp_path):
        with output_folder(tmp_path):
            write_bytes(tmp_path / "a", b"1")
            with pytest.raises(ResourceError):
                make_folder(tmp_path / "link" / "b")
            with pytest.raises(RefusedError):
                open_folder(tmp_path / "link")
        thread = threading.Thread(target=write_bytes, args=(tmp_path / "b", b"2"))
        thread.start()
        thread.join()
    assert len(os.listdir(descriptors)) == before and (tmp_path / "b").read_bytes() == b"2"
