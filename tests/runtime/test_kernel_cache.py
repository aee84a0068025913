"""Where kernels are compiled to: the usual folder, or a private one with a line that says so, or an error with its remedy."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from warpgs import folders
from warpgs.device import choose_kernel_cache

POSIX = pytest.mark.skipif(not hasattr(os, "getuid"), reason="mode bits say nothing on Windows")
HOMES = ("HOME", "USERPROFILE", "HOMEDRIVE", "HOMEPATH", "LOCALAPPDATA", "XDG_CACHE_HOME", "WARP_CACHE_PATH", "WARPGS_CACHE")

COMPILE = """
import os
import torch
import warp as wp
from warpgs.kernels import tiles
from warpgs.kernels import launch as interop

module = tiles.make_kernels(wp.float32, False).pack_counts.module
made = module.load(interop.warp_device(torch.device("cpu")), block_dim=1).binary_path
folder = wp.config.kernel_cache_dir
assert str(made).startswith(folder) and os.path.isfile(made)
print(folder, oct(os.stat(os.path.dirname(os.path.dirname(folder))).st_mode & 0o777))
"""

UNKNOWN = """
import grp, os, pwd, random, shutil, tempfile
import warp
from warpgs.device import prepare_kernel_cache
os.setgroups([])
os.setgid(54321)
os.setuid(54321)  # after the imports: where Python lies may not be for everyone
folder = prepare_kernel_cache()[0]
print(folder / "version", oct(os.stat(os.path.dirname(folder)).st_mode & 0o777))
"""


@pytest.fixture
def python(tmp_path):
    """Run code in an empty folder with no home but what is given; nothing may be left there."""
    here = tmp_path / "here"
    here.mkdir()

    def run(code: str, **variables: str) -> subprocess.CompletedProcess:
        environment = {k: v for k, v in os.environ.items() if k not in HOMES} | variables
        environment |= {"PYTHONPATH": str(Path(__file__).parent.parent.parent), "CUDA_VISIBLE_DEVICES": ""}
        done = subprocess.run(
            [sys.executable, "-c", code], env=environment, cwd=here, capture_output=True, text=True, check=False
        )
        assert not list(here.iterdir()), "a folder is left in the current one"
        return done

    return run


def private(done: subprocess.CompletedProcess, reason: str) -> None:
    """Assert that a kernel ran from a private folder, that one line said why, and that the folder is gone."""
    assert done.returncode == 0, done.stderr
    folder, mode = done.stdout.split()
    (line,) = [row for row in done.stderr.splitlines() if row.startswith("warpgs:")]
    assert reason in line and "WARP_CACHE_PATH" in line and str(Path(folder).parent) in line
    assert Path(folder).parent.parent.name.startswith("warpgs-") and not Path(folder).exists()
    assert mode == "0o700" or os.name == "nt"


def test_a_home_that_cannot_be_written(python, tmp_path):
    """A path below a file stands for /proc/1, a read-only disk and the like; kernels compile and run all the same."""
    (tmp_path / "file").write_text("")
    home = str(tmp_path / "file" / "home")
    private(python(COMPILE, HOME=home, USERPROFILE=home, LOCALAPPDATA=home), "cannot be written")


@pytest.mark.skipif(not hasattr(os, "getuid") or os.getuid() != 0, reason="to become a user that is not known takes root")
@pytest.mark.parametrize(("home", "reason"), [(None, "no home folder"), ("/", "cannot be written"), ("/proc/1", "cannot be")])
def test_a_user_that_the_system_does_not_know(python, home, reason):
    """As in containers that run under any number: no home, or one that belongs to somebody else."""
    private(python(UNKNOWN, **({} if home is None else {"HOME": home})), reason)


def test_nothing_can_be_written(python, tmp_path):
    """Exit class 4 and the remedy, from any command; not a defect."""
    (tmp_path / "file").write_text("")
    home = str(tmp_path / "file" / "home")
    code = """
import sys, tempfile
def refuse(*_, **__): raise FileNotFoundError(2, "No usable temporary directory found")
tempfile.gettempdir = refuse
from warpgs.app.cli import main
sys.exit(main(["eval", "run"]))
"""
    done = python(code, HOME=home, USERPROFILE=home, LOCALAPPDATA=home)
    assert done.returncode == 4 and "WARP_CACHE_PATH" in done.stderr and "TMPDIR" in done.stderr
    assert done.stderr.count("\n") == 1 and "defect" not in done.stderr


def chosen(monkeypatch, folder) -> tuple[Path, str]:
    monkeypatch.setenv("WARP_CACHE_PATH", str(folder))
    return choose_kernel_cache()


def test_a_sound_folder_is_used(monkeypatch, tmp_path):
    """It is made for this user alone; one that the user's program or Warp has set comes first."""
    assert chosen(monkeypatch, tmp_path / "new" / "cache") == ((tmp_path / "new" / "cache").resolve(), "")
    assert os.name == "nt" or (tmp_path / "new" / "cache").stat().st_mode & 0o777 == 0o700
    assert choose_kernel_cache(str(tmp_path / "mine")) == ((tmp_path / "mine").resolve(), "")


@POSIX
@pytest.mark.parametrize("where", ["cache", "cache/1.0", "cache/1.0/wp_x", "cache/1.0/wp_x/x.o", "."])
def test_a_folder_that_others_can_write_to_is_refused(monkeypatch, tmp_path, where):
    """They could plant a kernel, which would run as this user: in the cache, a version of it, a module, or in place of it."""
    cache = tmp_path / "cache"
    (cache / "1.0" / "wp_x").mkdir(parents=True)
    (cache / "1.0" / "wp_x" / "x.o").write_bytes(b"")
    cache.chmod(0o755)
    assert chosen(monkeypatch, cache) == (cache.resolve(), "")
    (tmp_path / where).chmod(0o777)
    folder, why = chosen(monkeypatch, cache)
    assert "other users can write to" in why and folder != cache.resolve()
    if where == ".":
        tmp_path.chmod(0o1777)  # as /tmp: others cannot move what is not theirs
        assert chosen(monkeypatch, cache) == (cache.resolve(), "")


@POSIX
def test_groups_links_and_owners(monkeypatch, tmp_path):
    """A group of other users may not write, the user's own may; links in a cache and folders of others are not followed."""
    from warpgs import locks

    cache = tmp_path / "cache"
    cache.mkdir()
    cache.chmod(0o775)
    monkeypatch.setattr(locks, "_is_own_group", lambda gid: True)
    assert not chosen(monkeypatch, cache)[1]
    monkeypatch.setattr(locks, "_is_own_group", lambda gid: False)
    assert "other users" in chosen(monkeypatch, cache)[1]
    cache.chmod(0o755)
    (cache / "1.0").symlink_to(tmp_path)
    assert "other users" in chosen(monkeypatch, cache)[1]
    cache.chmod(0o700)  # they cannot get in
    assert not chosen(monkeypatch, cache)[1]
    monkeypatch.setattr(os, "getuid", lambda: 12345)
    if cache.stat().st_uid:
        assert "other users" in chosen(monkeypatch, cache)[1]


@POSIX
@pytest.mark.parametrize(("planted", "refused"), [(".", True), ("cache", True), ("cache/1.0/wp_x/x.o", True), (None, False)])
def test_what_another_user_owns_is_refused(monkeypatch, tmp_path, planted, refused):
    """A folder above the cache, the cache, or a kernel planted in it: its owner can change it, whatever its mode says."""
    cache = tmp_path / "cache"
    (cache / "1.0" / "wp_x").mkdir(parents=True)
    (cache / "1.0" / "wp_x" / "x.o").write_bytes(b"")
    cache.chmod(0o755)
    stranger = tmp_path / planted if planted else None
    for name in ("stat", "lstat"):
        look = getattr(Path, name)

        def owned(path, look=look, **how):
            found = look(path, **how)
            return os.stat_result([*found[:4], 54321, *found[5:]]) if stranger is not None and path == stranger else found

        monkeypatch.setattr(Path, name, owned)
    folder, why = chosen(monkeypatch, cache)
    assert (folder != cache.resolve()) == refused == ("other users can write to" in why)


def test_where_files_have_no_owners_nothing_is_refused(monkeypatch, tmp_path):
    """As on Windows, where the folder of a user's caches is private and mode bits say nothing."""
    monkeypatch.delattr(os, "getuid", raising=False)
    tmp_path.chmod(0o777)
    assert chosen(monkeypatch, tmp_path / "cache") == ((tmp_path / "cache").resolve(), "")


def test_no_folder_is_ever_called_tilde(monkeypatch, tmp_path):
    """A ~ that nobody has replaced means the home folder; where that is not known, nothing is made."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    for name in ("HOME", "USERPROFILE"):
        monkeypatch.setenv(name, str(tmp_path / "home"))
    assert chosen(monkeypatch, "~/k") == ((tmp_path / "home" / "k").resolve(), "")
    for home in ("~", "relative"):
        for name in ("HOME", "USERPROFILE"):
            monkeypatch.setenv(name, home)
        assert "an unknown home folder" in chosen(monkeypatch, "~/k")[1]
        monkeypatch.delenv("WARP_CACHE_PATH")
        monkeypatch.delenv("LOCALAPPDATA", raising=False)
        assert folders.cache_home() is None and "no home" in choose_kernel_cache()[1]
    from warpgs.priors.networks import cache_folder

    for name in ("HOME", "USERPROFILE"):
        monkeypatch.setenv(name, str(tmp_path / "home"))
    monkeypatch.setenv("WARPGS_CACHE", "~/maps")  # of another cache, that of the networks' maps
    assert cache_folder() == tmp_path / "home" / "maps"
    assert {p.name for p in tmp_path.iterdir()} == {"home"}


@pytest.mark.parametrize("system", ["linux", "darwin", "win32"])
def test_the_place_on_each_system(monkeypatch, tmp_path, system):
    """Where Warp keeps its kernels by itself, so that what is compiled there is found."""
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    for name in ("XDG_CACHE_HOME", "LOCALAPPDATA", "WARP_CACHE_PATH"):
        monkeypatch.delenv(name, raising=False)
    wanted = {"linux": ".cache/warp", "darwin": "Library/Caches/warp", "win32": "AppData/Local/NVIDIA/warp/Cache"}[system]
    assert choose_kernel_cache() == ((tmp_path / wanted).resolve(), "")
