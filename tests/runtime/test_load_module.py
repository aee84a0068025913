"""A module is compiled by one process while another that needs it waits; nothing is locked once it is loaded."""

import errno
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
import warp as wp

from warpgs.runtime import interop, load_module

ROOT = Path(__file__).parent.parent.parent
OTHER = """
import torch
from tests.runtime.test_load_module import mark
from warpgs.runtime import interop, load_module
import warp
def refuse(*_, **__): raise AssertionError("compiled a second time")
warp._src.build.build_cpu = refuse
acquire = load_module._acquire
def note(file):
    print("waits", flush=True)
    acquire(file)
load_module._acquire = note
seen = torch.zeros(3, dtype=torch.int32)
interop.launch(mark, 3, [interop.view(seen, warp.int32)], torch.device("cpu"))
print(seen.tolist())
"""


@wp.kernel(enable_backward=False, module="unique")
def mark(begin: int, seen: wp.array(dtype=int)):
    i = begin + wp.tid()
    seen[i] = i + 1


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache for this process and those it starts; returns this version's folder."""
    folder = tmp_path / wp.config.version
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(folder))
    monkeypatch.setenv("WARP_CACHE_PATH", str(tmp_path))
    return folder


def test_two_processes_compile_a_module_once(cache):
    """The other process waits for the one that has the lock, finds the compiled module, and runs it."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "CUDA_VISIBLE_DEVICES": ""}
    name, cpu = mark.module.get_module_identifier(1), wp.get_device("cpu")
    (cache / "locks").mkdir(parents=True)
    with load_module.exclusive(cache / "locks" / f"{name}.0"):
        other = subprocess.Popen([sys.executable, "-c", OTHER], env=environment, stdout=subprocess.PIPE, text=True)
        assert other.stdout.readline() == "waits\n"
        mark.module.load(cpu, block_dim=1)
    assert other.communicate()[0] == "[1, 2, 3]\n" and other.returncode == 0


def test_a_loaded_module_takes_no_lock(cache, monkeypatch):
    """Neither the second launch nor any later one opens a file."""
    seen = torch.zeros(3, dtype=torch.int32)
    for _ in range(2):
        interop.launch(mark, 3, [interop.view(seen, wp.int32)], torch.device("cpu"))
        monkeypatch.setattr(load_module, "exclusive", None)
    assert seen.tolist() == [1, 2, 3]


def test_a_file_system_without_locks_is_no_obstacle(tmp_path, monkeypatch):
    def refuse(_):
        raise OSError(95, "not supported")

    monkeypatch.setattr(load_module, "_acquire", refuse)
    with load_module.exclusive(tmp_path / "lock"):
        pass
    with pytest.raises(OSError, match="of the body"), load_module.exclusive(tmp_path / "lock"):
        raise OSError("of the body")


def test_windows_has_other_calls(tmp_path, monkeypatch):
    """Its lock is asked for again where it gives up after ten seconds, and is on the first byte both times."""
    calls = []

    def locking(descriptor, mode, count):
        calls.append((mode, os.lseek(descriptor, 0, os.SEEK_CUR), count))
        if len(calls) == 1:
            raise OSError(errno.EDEADLOCK, "given up")

    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setitem(sys.modules, "msvcrt", SimpleNamespace(locking=locking, LK_LOCK="lock", LK_UNLCK="unlock"))
    with load_module.exclusive(tmp_path / "lock"):
        assert calls == [("lock", 0, 1)] * 2
    assert calls[2:] == [("unlock", 0, 1)]
