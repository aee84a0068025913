"""The report on the machine: never raises, names a remedy for what is missing, reads well in 80 columns."""

import importlib.metadata
import importlib.util
import io
import os
import sys
import types

import pytest
from rich.console import Console

from warpgs.app import doctor
from warpgs.app.cli import main
from warpgs.app.doctor import MISSING, NOTE, OK, Finding
from warpgs.errors import ResourceError
from warpgs.pipeline.run import precompile
from warpgs.report import progress


def text_of(findings, width=80, terminal=False):
    out = io.StringIO()
    code = doctor.print_report(findings, Console(file=out, width=width, force_terminal=terminal))
    return out.getvalue(), code


def by_topic(findings):
    return {f.topic: f for f in findings}


def test_missing_extras_are_named_with_what_they_are_for(monkeypatch):
    there = {"pycolmap", "viser", "zstandard"}
    monkeypatch.setattr(doctor.importlib.util, "find_spec", lambda name: object() if name in there else None)
    (found,) = doctor._extras()
    assert (found.status, found.detail, found.remedy) == (OK, "poses, view, formats", "")
    there -= {"pycolmap", "zstandard"}
    (found,) = doctor._extras()
    assert found.status == NOTE and "view; not installed: poses (photographs without cameras), formats" in found.detail
    extras = "[poses,formats]"
    assert found.remedy == f"`pip install '.{extras}'` in your copy of the repository, or add {extras} to the path of the wheel"


def test_this_machine_can_fit():
    findings = doctor.diagnose()
    topics = [f.topic for f in findings]
    assert len(topics) == len(set(topics)) and any(t.startswith("CUDA") for t in topics)
    usual = {"Python", "torch", "warp-lang", "CPU", "Memory", "Kernel cache", "Film encoder", "Disk"}
    assert usual <= {*topics}
    assert all(f.detail and f.status in (OK, MISSING, NOTE) and (f.remedy or f.status != MISSING) for f in findings)
    assert text_of(findings)[1] == 0


@pytest.mark.parametrize(
    ("name", "error", "topic", "status", "remedy", "code"),
    [
        ("safetensors", ModuleNotFoundError("No module"), "safetensors", MISSING, "pip install safetensors", 4),
        ("onnxruntime", ModuleNotFoundError("No module"), "onnxruntime", NOTE, "pip install onnxruntime", 0),
        ("cv2", ImportError("libGL.so.1"), "opencv-contrib-python-headless", MISSING, "system library", 4),
    ],
)
def test_a_package_that_cannot_be_imported(monkeypatch, name, error, topic, status, remedy, code):
    real = importlib.import_module

    def fake(module, *args):
        if module == name:
            raise error
        return real(module, *args)

    monkeypatch.setattr(importlib, "import_module", fake)
    findings = list(doctor._packages())
    f = by_topic(findings)[topic]
    assert f.status == status and str(error) in f.detail and remedy in f.remedy
    text, returned = text_of(findings)
    assert returned == code and ("cannot run yet: " in text) == bool(code) and f.remedy[:20] in text


def torch_like(cuda, available):
    properties = types.SimpleNamespace(name="GPU X", total_memory=24 * 2**30, major=8, minor=9)
    of_cuda = {"is_available": lambda: available, "device_count": lambda: 2, "get_device_properties": lambda i: properties}
    version, cuda = types.SimpleNamespace(cuda=cuda), types.SimpleNamespace(**of_cuda)
    return types.SimpleNamespace(__version__="9.9", version=version, cuda=cuda)


@pytest.mark.parametrize(
    ("cuda", "hidden", "words"),
    [
        (None, None, ("without CUDA", "CUDA build of torch")),
        ("13.0", "", ("hides", "unset")),
        ("13.0", None, ("driver", "13.0")),
    ],
)
def test_no_usable_device(monkeypatch, cuda, hidden, words):
    monkeypatch.setitem(sys.modules, "torch", torch_like(cuda, False))
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    if hidden is not None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", hidden)
    (f,) = doctor._cuda()
    assert f.status == NOTE and words[0] in f.detail and words[1] in f.remedy


@pytest.mark.parametrize(("both", "status", "words"), [(True, OK, "13.1"), (False, NOTE, "Warp sees no CUDA device")])
def test_devices_that_torch_sees(monkeypatch, both, status, words):
    found = {"is_cuda_available": both, "get_cuda_device_count": 2, "get_cuda_driver_version": (13, 1)}
    warp = types.SimpleNamespace(**{name: lambda value=value: value for name, value in found.items()})
    monkeypatch.setitem(sys.modules, "torch", torch_like("13.0", True))
    monkeypatch.setattr(doctor, "_quiet_warp", lambda: warp)
    first, second, last = doctor._cuda()
    assert first.topic == "CUDA 0" and second.topic == "CUDA 1" and "24.0 GiB" in first.detail
    assert last.status == status and words in last.detail and ("--device cpu" in last.remedy) != both


def test_a_cache_that_cannot_be_used(monkeypatch, tmp_path):
    """A private folder of kernels is a note, as a fit compiles each time; none at all stops it."""
    monkeypatch.setattr(doctor, "prepare_kernel_cache", lambda: (tmp_path, "it cannot be written"))
    (f,) = doctor._kernel_cache()
    assert f.status == NOTE and "cannot be written" in f.detail and "WARP_CACHE_PATH" in f.remedy

    def refuse():
        raise ResourceError("nowhere")

    monkeypatch.setattr(doctor, "prepare_kernel_cache", refuse)
    (f,) = doctor._kernel_cache()
    assert f.status == MISSING and "WARP_CACHE_PATH" in f.remedy


def test_encoder_disk_and_memory(monkeypatch, tmp_path):
    writer = types.SimpleNamespace(isOpened=lambda: False, release=lambda: None)
    monkeypatch.setattr("cv2.VideoWriter", lambda *a: writer)
    (f,) = doctor._video()
    assert f.status == NOTE and f.remedy
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda p: types.SimpleNamespace(free=2**20))
    monkeypatch.setattr(doctor, "machine_memory", lambda: (2**32, 2**30))
    found = by_topic([*doctor._disk(), *doctor._processor()])
    assert found["Disk"].status == found["Memory"].status == NOTE
    assert found["Disk"].remedy and "4.0 GiB" in found["Memory"].detail


def test_eighty_columns_keep_the_keys_whole():
    findings = [
        *(Finding(row[0], OK, "1.2.3") for row in doctor.PACKAGES),
        Finding("Kernel cache", MISSING, "/a/very/long/path" * 9, "set WARP_CACHE_PATH " + "so " * 40),
        Finding("CUDA", NOTE, "[bold]none[/bold] " + "word " * 30, "update"),
    ]
    text, code = text_of(findings)
    rows = text.splitlines()
    assert code == 4 and max(map(len, rows)) <= 80 and "\x1b" not in text
    for key in ("opencv-contrib", "onnxruntime", "scikit-image", "Kernel cache"):
        assert sum(row.strip().startswith(key) for row in rows) >= 1
    assert "fix: update" in text and "python-headless" not in text
    assert "[bold]none[/bold]" in text  # what was found is shown as it is, never read as markup
    assert text.replace("\n", "").replace(" ", "").count("/a/very/long/path") == 9
    assert "\x1b[" in text_of(findings, terminal=True)[0]


def test_a_failed_check_is_a_finding(monkeypatch):
    def _odd_check():
        raise RuntimeError("no such thing")

    monkeypatch.setattr(doctor, "CHECKS", (_odd_check,))
    (f,) = doctor.diagnose()
    assert f.topic == "Odd check" and f.status == NOTE and "no such thing" in f.detail


def test_a_driver_s_words_are_hidden_and_compiling_is_shown(monkeypatch, capfd):
    config = types.SimpleNamespace(log_level=1)
    fake = types.SimpleNamespace(config=config, LOG_ERROR=4, init=lambda: os.write(2, b"no driver\n"))
    monkeypatch.setitem(sys.modules, "warp", fake)
    monkeypatch.setattr(doctor, "prepare_kernel_cache", lambda: None)
    assert doctor._quiet_warp() is fake and fake.config.log_level == 1 and capfd.readouterr().err == ""
    monkeypatch.undo()
    lines = []
    monkeypatch.setattr(progress, "is_live", lambda: True)
    monkeypatch.setattr(progress._STATUS, "show", lines.append)
    monkeypatch.setattr(precompile, "print_warming", lambda: None)
    assert main(["doctor", "--warm"]) == 0 and lines == ["starting doctor", "compiling kernels"]
