"""One function opens every input file: pipes, devices and folders are refused before a byte is read, and sizes are bounded."""

import os
import socket
from pathlib import Path

import pytest

import warpgs
from warpgs import files
from warpgs.files import input_digest, open_input, read_input, read_start, unread_reason

PACKAGE = Path(warpgs.__file__).parent


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
@pytest.mark.parametrize("read", [open_input, read_input, input_digest, lambda p: read_start(p, 4)])
def test_what_is_no_regular_file_is_refused(kind, words, read, tmp_path):
    with pytest.raises(OSError) as e:
        read(special(kind, tmp_path / "x"))
    assert words in unread_reason(e.value) and str(tmp_path) in str(e.value)


def test_a_pipe_that_takes_the_place_of_a_file_does_not_block(tmp_path, monkeypatch):
    pipe, file = special("pipe", tmp_path / "p"), tmp_path / "f"
    file.write_bytes(b"x")
    ordinary = os.stat(file)
    monkeypatch.setattr(files.os, "stat", lambda path: ordinary)
    with pytest.raises(OSError, match="is not a regular file"):
        open_input(pipe)


def test_sizes_are_bounded_before_and_while_reading(tmp_path, monkeypatch):
    path = tmp_path / "f"
    path.write_bytes(b"12345678")
    assert read_input(path, 8) == b"12345678" and read_start(path, 3) == b"123"
    with pytest.raises(OSError, match="larger than 7 bytes"):
        read_input(path, 7)
    with path.open("wb") as f:
        f.truncate(2**40)  # a hole: takes no disk
    with pytest.raises(OSError, match="larger than 16,384 MiB"):
        read_input(path)


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="only Linux has files without a size")
def test_files_without_a_size_are_read_whole_and_bounded(tmp_path):
    assert b"VmPeak" in read_input("/proc/self/status")
    with pytest.raises(OSError, match="larger than 10 bytes"):
        read_input("/proc/self/status", 10)


def test_descriptors_are_closed_blocking_and_not_inherited(tmp_path):
    (tmp_path / "f").write_bytes(b"x")
    with open_input(tmp_path / "f") as file:
        assert os.get_blocking(file.fileno()) if os.name != "nt" else True
        assert not os.get_inheritable(file.fileno())
    if os.name != "nt":
        before = len(os.listdir("/proc/self/fd")) if Path("/proc/self/fd").exists() else 0
        with pytest.raises(OSError):
            open_input(tmp_path)
        assert before == (len(os.listdir("/proc/self/fd")) if before else 0)
