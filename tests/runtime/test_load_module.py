"""A module is compiled by one process while another that needs it waits; nothing is locked once it is loaded."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import warp as wp

from warpgs.errors import ResourceError
from warpgs.kernels import launch, native

ROOT = Path(__file__).parent.parent.parent
OTHER = """
import torch
from tests.runtime.test_load_module import mark
from warpgs.errors import ResourceError
from warpgs.kernels import launch as interop
from warpgs.kernels import native as load_module
import warp
def refuse(*_, **__): raise AssertionError("compiled a second time")
warp._src.build.build_cpu = refuse
lock = load_module.lock_descriptor
def note(descriptor):
    print("waits", flush=True)
    lock(descriptor)
load_module.lock_descriptor = note
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
    with native.exclusive(cache / "locks" / f"{name}.0"):
        other = subprocess.Popen([sys.executable, "-c", OTHER], env=environment, stdout=subprocess.PIPE, text=True)
        assert other.stdout.readline() == "waits\n"
        mark.module.load(cpu, block_dim=1)
    assert other.communicate()[0] == "[1, 2, 3]\n" and other.returncode == 0


def test_a_loaded_module_takes_no_lock(cache, monkeypatch):
    """Neither the second launch nor any later one opens a file."""
    seen = torch.zeros(3, dtype=torch.int32)
    for _ in range(2):
        launch.launch(mark, 3, [launch.view(seen, wp.int32)], torch.device("cpu"))
        monkeypatch.setattr(native, "exclusive", None)
    assert seen.tolist() == [1, 2, 3]


def test_a_listener_hears_of_modules_that_the_cache_lacks(cache, monkeypatch):
    """Once: not of one that the cache holds by now, nor after the block."""
    cpu, heard, took = wp.get_device("cpu"), [], []
    for _ in range(2):
        monkeypatch.setattr(native, "_LOADED", set())
        mark.module.unload()
        with native.told_of_compiling(heard.append) as seconds:
            native.load_module(mark.module, cpu, 1)
        took.append(len(seconds))
        assert heard == [mark.module.get_module_identifier(1)]
    assert not native._LISTENERS and took == [1, 0]


def test_a_file_system_without_locks_is_no_obstacle(tmp_path, monkeypatch):
    def refuse(_):
        raise OSError(95, "not supported")

    monkeypatch.setattr(native, "lock_descriptor", refuse)
    with native.exclusive(tmp_path / "lock"):
        pass
    with pytest.raises(OSError, match="of the body"), native.exclusive(tmp_path / "lock"):
        raise OSError("of the body")


def test_a_lock_that_cannot_be_made_is_named_with_a_remedy(tmp_path):
    with pytest.raises(ResourceError, match="WARP_CACHE_PATH"), native.exclusive(tmp_path / "no" / "lock"):
        pytest.fail("held")
