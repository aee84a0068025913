"""Memory and processor on systems that lack what this one has, by stand-ins for what they read."""

import os
import platform
import sys
from types import SimpleNamespace

import pytest
import torch

from warpgs import device
from warpgs.device import available_bytes, container_memory, installed_bytes, machine_memory

CPU, GIB = torch.device("cpu"), 2**30


def psutil_like(found):
    """Return a stand-in for psutil that finds this, or raises it."""

    def virtual_memory():
        if isinstance(found, Exception):
            raise found
        return found

    return SimpleNamespace(virtual_memory=virtual_memory)


@pytest.fixture
def elsewhere(monkeypatch, tmp_path):
    """A machine without /proc and /sys, of 16 GiB, 10 of them free; nothing is remembered of this one."""
    monkeypatch.setattr(device, "OWN_CGROUPS", tmp_path / "proc")
    monkeypatch.setattr(device, "CGROUPS", tmp_path / "sys")
    monkeypatch.setattr(device, "CPU_INFO", tmp_path / "cpuinfo")
    monkeypatch.setitem(sys.modules, "psutil", psutil_like(SimpleNamespace(total=16 * GIB, available=10 * GIB)))
    forgotten = (device.installed_bytes, device._say_assumed)
    for f in forgotten:
        f.cache_clear()
    yield tmp_path
    for f in forgotten:
        f.cache_clear()


def group(root, parts: str, **files):
    """Write the files of a control group; a double underscore stands for a point."""
    folder = root / "sys" / parts
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / name.replace("__", ".")).write_text(f"{text}\n", "utf-8")


def test_this_machine():
    """Something between a small computer and a large one; free is less than installed."""
    assert 2**28 < installed_bytes(CPU) < 2**46 and 2**20 < available_bytes(CPU) <= installed_bytes(CPU)
    assert 1 <= device.usable_cores() <= (os.cpu_count() or 1) and device.processor_name()


def test_without_control_groups(elsewhere):
    """As on macOS and Windows: what psutil says."""
    assert container_memory() is None and machine_memory() == (16 * GIB, 10 * GIB)
    assert (installed_bytes(CPU), available_bytes(CPU)) == (16 * GIB, 10 * GIB)


def test_limits_of_version_2(elsewhere):
    """The tightest group between the process and the root counts; file pages not used lately are free."""
    (elsewhere / "proc").write_text("0::/a/b\n", "utf-8")
    group(elsewhere, "", memory__stat="anon 5")  # the root has no limit file
    group(elsewhere, "a", memory__max=4 * GIB, memory__current=3 * GIB, memory__stat=f"anon 1\ninactive_file {GIB}")
    group(elsewhere, "a/b", memory__max="max", memory__current=1)
    assert container_memory() == machine_memory() == (4 * GIB, 2 * GIB)
    group(elsewhere, "a/b", memory__max=3 * GIB, memory__current=GIB, memory__stat="")
    assert machine_memory() == (3 * GIB, 2 * GIB)
    group(elsewhere, "a", memory__current=6 * GIB)
    assert machine_memory() == (3 * GIB, 0)


@pytest.mark.parametrize("own", ["0::/\n", "0::/../elsewhere\n", "", "odd\n0::\n", None])
def test_the_root_of_a_container_is_its_own_group(elsewhere, own):
    """Also where the process's path cannot be read, leaves the mounted tree, or is not what it must be."""
    if own is not None:
        (elsewhere / "proc").write_text(own, "utf-8")
    group(elsewhere, "", memory__max=GIB, memory__current=2**20)
    assert machine_memory() == (GIB, GIB - 2**20)


def test_limits_of_version_1(elsewhere):
    """No limit is a large number; the group's path may lie outside of what the container sees."""
    (elsewhere / "proc").write_text("4:cpu,memory:/docker/x\n1:name=systemd:/\n0::/\n", "utf-8")
    none = {"memory__limit_in_bytes": 2**63 - 4096, "memory__usage_in_bytes": GIB}
    group(elsewhere, "memory", **none)
    assert container_memory() is None
    group(elsewhere, "memory", memory__limit_in_bytes=2 * GIB, memory__stat=f"total_inactive_file {GIB // 2}")
    assert machine_memory() == (2 * GIB, 3 * GIB // 2)
    group(elsewhere, "memory/docker/x", memory__limit_in_bytes=GIB)  # what is used is not said
    assert machine_memory() == (GIB, GIB)


def test_a_limit_above_the_machine_changes_nothing(elsewhere):
    """Nor does a file of nonsense."""
    group(elsewhere, "", memory__max=64 * GIB, memory__current=0)
    assert machine_memory() == (16 * GIB, 10 * GIB)
    group(elsewhere, "", memory__max="-7 or so")
    assert container_memory() is None


REFUSALS = [FileNotFoundError("/proc/meminfo"), PermissionError("/proc"), RuntimeError("host_statistics64"), None]


@pytest.mark.parametrize("found", [*REFUSALS, SimpleNamespace(total=GIB)], ids=[*map(repr, REFUSALS), "no field"])
def test_a_system_that_says_nothing(elsewhere, monkeypatch, capsys, found):
    """A stated amount is assumed, with one line; a container's limit still counts."""
    monkeypatch.setitem(sys.modules, "psutil", found and psutil_like(found))  # None: it cannot be imported
    assert machine_memory() is None
    assert [available_bytes(CPU), available_bytes(CPU), installed_bytes(CPU)] == [device.ASSUMED_BYTES] * 3
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "2 GiB are assumed" in said
    group(elsewhere, "", memory__max=GIB, memory__current=2**20)
    assert available_bytes(CPU) == GIB - 2**20 and not capsys.readouterr().err


def test_memory_that_torch_holds_unused_is_available(monkeypatch):
    """Free on a CUDA device is what the driver says, and what torch has reserved and not given out."""
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda _: (1000, 5000))
    monkeypatch.setattr(torch.cuda, "memory_reserved", lambda _: 300)
    monkeypatch.setattr(torch.cuda, "memory_allocated", lambda _: 20)
    assert available_bytes(torch.device("cuda", 0)) == 1280


@pytest.mark.parametrize("system", ["Darwin", "Windows"])
def test_a_processor_without_affinity_or_proc(elsewhere, monkeypatch, system):
    """All cores are usable, and the name is what Python knows."""
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 12)
    monkeypatch.setattr(platform, "processor", lambda: {"Darwin": "arm", "Windows": ""}[system])
    monkeypatch.setattr(platform, "machine", lambda: "AMD64")
    assert device.usable_cores() == 12
    assert device.processor_name() == {"Darwin": "arm", "Windows": "AMD64"}[system]
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    monkeypatch.setattr(platform, "machine", lambda: "")
    assert device.usable_cores() == 1 and device.processor_name()


def test_a_processor_that_linux_names(elsewhere, monkeypatch):
    """The model, and the cores that the process is bound to."""
    (elsewhere / "cpuinfo").write_text("processor : 0\nmodel name\t: Some Processor: 3\n", "utf-8")
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {3, 5}, raising=False)
    assert device.processor_name() == "Some Processor: 3" and device.usable_cores() == 2
