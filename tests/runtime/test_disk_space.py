"""A full disk of another process is called that, and neither a lack of memory nor a fault of a renderer."""

import errno
import os
import sqlite3
import subprocess
import sys

import pytest

from warpgs import files as disk_space
from warpgs.errors import ResourceError
from warpgs.files import disk_is_full
from warpgs.poses import mapping
from warpgs.process import ProcessFailed
from warpgs.report.overview import remedy_for, run_pyvista

FULL = f"[Errno {errno.ENOSPC}] {os.strerror(errno.ENOSPC)}"


def test_words_and_room(tmp_path, monkeypatch):
    assert disk_is_full(tmp_path, f"OSError: {FULL}: 'a.png'") and not disk_is_full(tmp_path, "Segmentation fault")
    with pytest.raises(sqlite3.OperationalError) as e:
        database = sqlite3.connect(tmp_path / "a.db")
        database.execute("pragma max_page_count = 2")
        database.execute("create table a (x)")
        database.execute("insert into a values (zeroblob(100000))")
    assert disk_is_full(tmp_path, str(e.value))
    monkeypatch.setattr(disk_space, "MIN_FREE", 2**80)
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


def test_a_renderer():
    works, why = run_pyvista(f"import os; raise OSError({errno.ENOSPC}, os.strerror({errno.ENOSPC}))")
    assert not works and remedy_for(why).startswith("free some disk space for temporary files in ")
    assert "renderer" in remedy_for(run_pyvista("raise SystemExit(3)")[1])


@pytest.mark.fault
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="no Linux mount")
@pytest.mark.parametrize("command", ["poses", "plot"])
def test_real_disks(tmp_path, command):
    """A file system in memory that is nearly full holds the results, or the temporary files."""
    disk, files = tmp_path / "disk", tmp_path / "files"
    for folder in (disk, files):
        folder.mkdir()
    size = {"poses": "size=1m", "plot": "size=4k"}[command]
    if subprocess.run(["mount", "-t", "tmpfs", "-o", size, "tmpfs", str(disk)], capture_output=True, check=False).returncode:
        pytest.skip("this user cannot mount")
    try:
        program = [sys.executable, "-P", "-m", "warpgs"]
        subprocess.run(
            [*program, "demo", str(files / "scene"), "--views", "8", "--width", "320", "--height", "240"], check=True
        )
        words = ["poses", str(files / "scene" / "images"), "--out", str(disk / "scene")]
        environment = dict(os.environ)
        if command == "plot":
            fit = ["fit", str(files / "scene"), "--out", str(files / "run"), "--steps", "2", "--device", "cpu"]
            subprocess.run([*program, *fit, "--preset", "3dgs", "--init.source", "random"], check=True)
            words, environment["TMPDIR"] = ["plot", str(files / "run"), "--device", "cpu"], str(disk)
        done = subprocess.run([*program, *words], capture_output=True, text=True, env=environment, check=False)
        assert done.returncode == 4, done.stderr
        assert "disk" in done.stderr and "memory" not in done.stderr and "renderer" not in done.stderr
        assert str(disk) in done.stderr or os.strerror(errno.ENOSPC) in done.stderr
    finally:
        subprocess.run(["umount", "-l", str(disk)], check=True)
