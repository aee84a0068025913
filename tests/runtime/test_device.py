"""The machine: memory and its units, processors, idle threads, and the cache of kernels."""

import os
import platform
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from warpgs import device, folders, locks
from warpgs.errors import UsageError
from warpgs.priors.networks import cache_folder


def test_results_keep_the_order_of_their_arguments_which_are_made_late():
    """At most twice as many arguments as threads are made before the first of them is done; an error reaches the caller."""
    made, ahead, go = [], [], threading.Event()

    def arguments():
        for i in range(9):
            made.append(i)
            if len(made) == 3:
                go.set()
            yield i, 1

    def work(i, one):
        go.wait(10)
        ahead.append(len(made) - len(ahead))
        return i + one

    assert device.in_background(work, arguments(), 2) == [*range(1, 10)]
    assert max(ahead) <= 4
    with pytest.raises(ZeroDivisionError):
        device.in_background(lambda i: 1 // i, ((1,), (0,)))
    with pytest.raises(ZeroDivisionError), device.background(2) as start:
        start(lambda: 1 // 0)  # nobody asks for its result
    assert device.in_background(work, ()) == []


def woken():
    """Start the driver, and wait for the end of that."""
    device.wake_gpu()
    for thread in threading.enumerate():
        if thread.name == "driver":
            thread.join()


@pytest.mark.parametrize(
    ("library", "failing", "count"), [("libtorch_cuda.so", 0, 2), ("libtorch_cuda.so", 100, 1), ("", 0, 0)]
)
def test_a_driver_is_started_for_a_torch_that_can_use_it(library, failing, count, tmp_path, monkeypatch):
    """With the context of the first device; nothing is raised without a device, a driver, or the whole of torch."""
    calls, spec = [], SimpleNamespace(submodule_search_locations=[str(tmp_path)])
    driver = SimpleNamespace(
        cuInit=lambda flags: calls.append(("cuInit", flags)) or failing,
        cuDevicePrimaryCtxRetain=lambda context, handle: calls.append(("cuDevicePrimaryCtxRetain", handle)) or 0,
    )
    errors: list = []
    monkeypatch.setattr(threading, "excepthook", errors.append)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: spec)
    monkeypatch.setattr("ctypes.CDLL", lambda name: driver)
    woken()
    (tmp_path / "lib" / (library or "libtorch_cpu.so")).mkdir(parents=True)
    woken()
    assert calls == [("cuInit", 0), ("cuDevicePrimaryCtxRetain", 0)][:count]
    monkeypatch.undo()
    monkeypatch.setattr(threading, "excepthook", errors.append)
    woken()
    assert not errors


def test_a_fit_alone_starts_the_driver_before_its_imports():
    """Not where it names a device, nor in any other command, nor in another rank."""
    code = """
import os
from types import SimpleNamespace
from warpgs.app import cli
cli.wake_gpu = lambda: print("woken", end=" ")
cli.importlib = SimpleNamespace(import_module=lambda name: SimpleNamespace(run=lambda *a: print(name, end=" ") or 0))
for words in (["fit", "scene"], ["fit", "scene", "--device=cpu"], ["fit", "--help-all"], ["view", "run"]):
    cli.main(words)
os.environ["RANK"] = "1"
cli.main(["fit", "scene"])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    fit, others = "warpgs.app.fit", "warpgs.app.commands"
    assert done.stdout.split() == ["woken", fit, fit, fit, others, fit]


def test_sizes_are_read_and_written():
    for text, size in {"2GiB": 2**31, "512 MB": 512 * 10**6, "1.5kib": 1536, ".5 TB": 5 * 10**11, "7B": 7}.items():
        assert device.parse_bytes(text) == size
    for text in ("", "2", "-1GiB", "1e3MB", "0.1B", "2GiB!", "9" * 400 + "B", "٣GiB"):
        with pytest.raises(UsageError, match="memory limit"):
            device.parse_bytes(text)
    sizes = {5: "5 B", 2048: "2 KiB", 3 * 2**20: "3.0 MiB", 2.5 * 2**30: "2.5 GiB", 2**41: "2.0 TiB"}
    assert {n: device.format_bytes(n) for n in sizes} == sizes


# Memory and processor on systems that lack what this one has, by stand-ins for what they read.

CPU, GIB = torch.device("cpu"), 2**30


def psutil_like(**found):
    """Return a stand-in for psutil that finds this."""
    return SimpleNamespace(virtual_memory=lambda: SimpleNamespace(**found))


@pytest.fixture
def elsewhere(monkeypatch, tmp_path):
    """A machine without /proc and /sys, of 16 GiB, 10 of them free; nothing is remembered of this one."""
    for name, file in (("OWN_CGROUPS", "proc"), ("CGROUPS", "sys"), ("CPU_INFO", "cpuinfo")):
        monkeypatch.setattr(device, name, tmp_path / file)
    monkeypatch.setitem(sys.modules, "psutil", psutil_like(total=16 * GIB, available=10 * GIB))
    device.installed_bytes.cache_clear()
    yield tmp_path
    device.installed_bytes.cache_clear()


def group(root, parts: str, **files):
    """Write the files of a control group; a double underscore stands for a point."""
    folder = root / "sys" / parts
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / name.replace("__", ".")).write_text(f"{text}\n", "utf-8")


def test_this_machine_and_memory_that_torch_holds_unused(monkeypatch):
    assert 2**28 < device.installed_bytes(CPU) < 2**46 and 2**20 < device.available_bytes(CPU) <= device.installed_bytes(CPU)
    assert 1 <= device.usable_cores() <= (os.cpu_count() or 1) and device.processor_name()
    # free on a CUDA device is what the driver says, and what torch has reserved and not given out
    for name, value in (("mem_get_info", (1000, 5000)), ("memory_reserved", 300), ("memory_allocated", 20)):
        monkeypatch.setattr(torch.cuda, name, lambda _, value=value: value)
    assert device.available_bytes(torch.device("cuda", 0)) == 1280


def test_without_control_groups(elsewhere):
    assert device.container_memory() is None and device.machine_memory() == (16 * GIB, 10 * GIB)
    assert (device.installed_bytes(CPU), device.available_bytes(CPU)) == (16 * GIB, 10 * GIB)
    group(elsewhere, "", memory__max=64 * GIB, memory__current=0)
    assert device.machine_memory() == (16 * GIB, 10 * GIB)
    group(elsewhere, "", memory__max="-7 or so")
    assert device.container_memory() is None
    # limits of version 1: none is a large number; the group's path may lie outside of what the container sees
    (elsewhere / "proc").write_text("4:cpu,memory:/docker/x\n1:name=systemd:/\n0::/\n", "utf-8")
    none = {"memory__limit_in_bytes": 2**63 - 4096, "memory__usage_in_bytes": GIB}
    group(elsewhere, "memory", **none)
    assert device.container_memory() is None
    group(elsewhere, "memory", memory__limit_in_bytes=2 * GIB, memory__stat=f"total_inactive_file {GIB // 2}")
    assert device.machine_memory() == (2 * GIB, 3 * GIB // 2)
    group(elsewhere, "memory/docker/x", memory__limit_in_bytes=GIB)  # what is used is not said
    assert device.machine_memory() == (GIB, GIB)


def test_limits_of_version_2(elsewhere):
    """The tightest group between the process and the root counts; file pages not used lately are free."""
    (elsewhere / "proc").write_text("0::/a/b\n", "utf-8")
    group(elsewhere, "", memory__stat="anon 5")  # the root has no limit file
    group(elsewhere, "a", memory__max=4 * GIB, memory__current=3 * GIB, memory__stat=f"anon 1\ninactive_file {GIB}")
    group(elsewhere, "a/b", memory__max="max", memory__current=1)
    assert device.container_memory() == device.machine_memory() == (4 * GIB, 2 * GIB)
    group(elsewhere, "a/b", memory__max=3 * GIB, memory__current=GIB, memory__stat="")
    assert device.machine_memory() == (3 * GIB, 2 * GIB)
    group(elsewhere, "a", memory__current=6 * GIB)
    assert device.machine_memory() == (3 * GIB, 0)


@pytest.mark.parametrize("own", ["0::/\n", "0::/../elsewhere\n", "", "odd\n0::\n", None])
def test_the_root_of_a_container_is_its_own_group(elsewhere, own):
    """Also where the process's path cannot be read, leaves the mounted tree, or is not what it must be."""
    if own is not None:
        (elsewhere / "proc").write_text(own, "utf-8")
    group(elsewhere, "", memory__max=GIB, memory__current=2**20)
    assert device.machine_memory() == (GIB, GIB - 2**20)


def test_processors(elsewhere, monkeypatch):
    """Linux names the model and the cores of the process; elsewhere all are usable, and Python may know a name."""
    (elsewhere / "cpuinfo").write_text("processor : 0\nmodel name\t: Some Processor: 3\n", "utf-8")
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {3, 5}, raising=False)
    assert device.processor_name() == "Some Processor: 3" and device.usable_cores() == 2
    (elsewhere / "cpuinfo").unlink()
    monkeypatch.delattr(os, "sched_getaffinity")
    for processor, machine, cores in (("arm", "AMD64", 12), ("", "AMD64", 12), ("", "", None)):
        monkeypatch.setattr(os, "cpu_count", lambda cores=cores: cores)
        monkeypatch.setattr(platform, "processor", lambda name=processor: name)
        monkeypatch.setattr(platform, "machine", lambda name=machine: name)
        assert device.usable_cores() == (cores or 1)
        assert device.processor_name() == (processor or machine or "unknown")


# Where kernels are compiled to: the usual folder, a private one with a line that says so, or an error with its remedy.

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

NOTHING = """
import sys, tempfile
def refuse(*_, **__): raise FileNotFoundError(2, "No usable temporary directory found")
tempfile.gettempdir = refuse
from warpgs.app.cli import main
sys.exit(main(["eval", "run"]))
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
    """A path below a file stands for a read-only disk: kernels still run; if nothing else can be written, that is said."""
    (tmp_path / "file").write_text("")
    homes = dict.fromkeys(("HOME", "USERPROFILE", "LOCALAPPDATA"), str(tmp_path / "file" / "home"))
    private(python(COMPILE, **homes), "cannot be written")
    done = python(NOTHING, **homes)
    assert done.returncode == 4 and "WARP_CACHE_PATH" in done.stderr and "TMPDIR" in done.stderr
    assert done.stderr.count("\n") == 1 and "defect" not in done.stderr


@pytest.mark.skipif(not hasattr(os, "getuid") or os.getuid() != 0, reason="to become a user that is not known takes root")
@pytest.mark.parametrize(("home", "reason"), [(None, "no home folder"), ("/proc/1", "cannot be")])
def test_a_user_that_the_system_does_not_know(python, home, reason):
    """As in containers that run under any number: no home, or one that belongs to somebody else."""
    private(python(UNKNOWN, **({} if home is None else {"HOME": home})), reason)


def chosen(monkeypatch, folder) -> tuple[Path, str]:
    monkeypatch.setenv("WARP_CACHE_PATH", str(folder))
    return device.choose_kernel_cache()


def filled_cache(folder: Path) -> Path:
    cache = folder / "cache"
    (cache / "1.0" / "wp_x").mkdir(parents=True)
    (cache / "1.0" / "wp_x" / "x.o").write_bytes(b"")
    cache.chmod(0o755)
    return cache


def test_a_sound_folder_is_used(monkeypatch, tmp_path):
    """It is made for this user alone; one that the user's program or Warp has set comes first."""
    assert chosen(monkeypatch, tmp_path / "new" / "cache") == ((tmp_path / "new" / "cache").resolve(), "")
    assert os.name == "nt" or (tmp_path / "new" / "cache").stat().st_mode & 0o777 == 0o700
    assert device.choose_kernel_cache(str(tmp_path / "mine")) == ((tmp_path / "mine").resolve(), "")
    monkeypatch.delattr(os, "getuid", raising=False)  # where files have no owners nothing is refused
    tmp_path.chmod(0o777)
    assert chosen(monkeypatch, tmp_path / "cache") == ((tmp_path / "cache").resolve(), "")


@POSIX
@pytest.mark.parametrize("where", ["cache", "cache/1.0", "cache/1.0/wp_x", "cache/1.0/wp_x/x.o", "."])
def test_a_folder_that_others_can_write_to_is_refused(monkeypatch, tmp_path, where):
    """They could plant a kernel, which would run as this user: in the cache, a version of it, a module, or in place of it."""
    cache = filled_cache(tmp_path)
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
    cache = filled_cache(tmp_path)
    stranger = tmp_path / planted if planted else None
    for name in ("stat", "lstat"):
        look = getattr(Path, name)

        def owned(path, look=look, **how):
            found = look(path, **how)
            return os.stat_result([*found[:4], 54321, *found[5:]]) if stranger is not None and path == stranger else found

        monkeypatch.setattr(Path, name, owned)
    folder, why = chosen(monkeypatch, cache)
    assert (folder != cache.resolve()) == refused == ("other users can write to" in why)


def test_no_folder_is_ever_called_tilde(monkeypatch, tmp_path):
    """A ~ that nobody has replaced means the home folder; where that is not known, nothing is made."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)

    def homes(home):
        for name in ("HOME", "USERPROFILE"):
            monkeypatch.setenv(name, str(home))

    homes(tmp_path / "home")
    assert chosen(monkeypatch, "~/k") == ((tmp_path / "home" / "k").resolve(), "")
    for home in ("~", "relative"):
        homes(home)
        assert "no home folder" in chosen(monkeypatch, "~/k")[1]
        monkeypatch.delenv("WARP_CACHE_PATH")
        monkeypatch.delenv("LOCALAPPDATA", raising=False)
        assert folders.cache_home() is None and "no home" in device.choose_kernel_cache()[1]
    homes(tmp_path / "home")
    monkeypatch.setenv("WARPGS_CACHE", "~/maps")  # of another cache, that of the networks' maps
    assert cache_folder() == tmp_path / "home" / "maps"
    assert {p.name for p in tmp_path.iterdir()} == {"home"}


@pytest.mark.parametrize("system", ["linux", "darwin", "win32"])
def test_the_place_on_each_system(monkeypatch, tmp_path, system):
    """Warp's own default, so that kernels compiled there are found."""
    monkeypatch.setattr(sys, "platform", system)
    for name in ("HOME", "USERPROFILE"):
        monkeypatch.setenv(name, str(tmp_path))
    for name in ("XDG_CACHE_HOME", "LOCALAPPDATA", "WARP_CACHE_PATH"):
        monkeypatch.delenv(name, raising=False)
    wanted = {"linux": ".cache/warp", "darwin": "Library/Caches/warp", "win32": "AppData/Local/NVIDIA/warp/Cache"}[system]
    assert device.choose_kernel_cache() == ((tmp_path / wanted).resolve(), "")


# Idle threads of OpenMP: they sleep where warpgs is imported first, and a warning says so where they do not.

RENDER = """
n = 5000
g = warpgs.Gaussians(torch.rand(n, 3), torch.rand(n, 4), torch.rand(n, 3) - 4, torch.zeros(n), torch.zeros(n, 1, 3))
camera = warpgs.Camera(torch.eye(4), torch.eye(3), 16, 16)
for threads in (1, 2, 2):
    torch.set_num_threads(threads)
    warpgs.rasterize(g, camera)
    print("rendered", threads, file=sys.stderr)
"""
"""5,000 Gaussians are enough work for the threads of a launch (`interop.SERIAL_WORK`)."""


@pytest.mark.parametrize(
    "imports, policy, warned", [("torch, warpgs", None, 1), ("warpgs, torch", None, 0), ("torch, warpgs", "active", 0)]
)
def test_a_warning_where_torch_was_imported_first(imports, policy, warned):
    """Once, in the first render with threads, unless the environment says how OpenMP waits."""
    environment = {k: v for k, v in os.environ.items() if k != "OMP_WAIT_POLICY"}
    if policy:
        environment["OMP_WAIT_POLICY"] = policy
    code = f"import sys\nimport {imports}\n{RENDER}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    alone, *threaded = done.stderr.split("rendered 1")
    assert "OMP_WAIT_POLICY" not in alone
    assert threaded[0].count("set OMP_WAIT_POLICY=passive, call torch.set_num_threads(1), or import") == warned
    assert threaded[0].count("<string>:9: RuntimeWarning") == warned  # the line that calls rasterize
