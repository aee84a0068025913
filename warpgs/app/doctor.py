"""`warpgs doctor`: checks of this machine, each by itself."""

import importlib
import importlib.util
import os
import platform
import shutil
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from warpgs.app.flags import call
from warpgs.device import format_bytes, machine_memory, prepare_kernel_cache, processor_name, usable_cores
from warpgs.errors import ResourceError, install_extras
from warpgs.process import Say, counted, fast_imports, hidden_stderr, printable, silent
from warpgs.report.progress import Stages, waiting

OK, MISSING, NOTE = "ok", "missing", "note"
LOW_DISK = 2 * 2**30  # [bytes]; a run folder with checkpoints and a video fits well into this
LOW_MEMORY = 4 * 2**30  # [bytes]


@dataclass(frozen=True)
class Finding:
    """Result of one check."""

    topic: str
    """Subject in a few words, unique within a report."""
    status: Literal["ok", "missing", "note"]
    """``missing`` where no fit works; ``note`` where a fit works, but slower or with fewer features."""
    detail: str
    """Observation, as text."""
    remedy: str = ""
    """Fix; never empty where the status is ``missing``."""


PACKAGES = (
    ("torch", "torch", True, "tensors and gradients"),
    ("warp-lang", "warp", True, "the rasterizer's kernels"),
    ("numpy", "numpy", True, "reading scenes"),
    ("scipy", "scipy", True, "rotations and neighbours"),
    ("scikit-image", "skimage", False, "`warpgs mesh`"),
    ("opencv-contrib-python-headless", "cv2", True, "images, matches, video"),
    ("psutil", "psutil", True, "free memory"),
    ("safetensors", "safetensors", True, "checkpoints"),
    ("onnxruntime", "onnxruntime", False, "depth and feature networks"),
    ("pyvista", "pyvista", False, "`warpgs mesh`"),
)
"""Packages: name in the package index, module, whether a fit needs it, and the feature that does not work without it."""
EXTRAS = {
    "poses": ("pycolmap", "photographs without cameras"),
    "view": ("viser", "the viewer and HTML pages of models"),
    "formats": ("zstandard", "SPZ of version 4"),
}
"""Optional dependencies by name: the module by which each is detected, and its purpose."""


def _reason(error: BaseException) -> str:
    """Return the first line of an error, short enough for a table."""
    text = str(error).strip().splitlines()
    return f"{type(error).__name__}: {text[0][:160]}" if text else type(error).__name__


def _noted(topic: str, sound: bool, detail: str, remedy: str) -> Finding:
    """Return a finding that is a note with a remedy unless it is ``sound``."""
    return Finding(topic, OK, detail) if sound else Finding(topic, NOTE, detail, remedy)


def _python() -> Iterable[Finding]:
    yield Finding("Python", OK, f"{platform.python_version()} at {sys.executable}")
    yield Finding("System", OK, f"{platform.system()} {platform.release()} on {platform.machine()}")


def _package(distribution: str, name: str, required: bool, use: str) -> Finding:
    """Import a package, since an installed package may still lack a system library."""
    try:
        module = importlib.import_module(name)
    except Exception as e:
        remedy = f"pip install {distribution}"
        if not isinstance(e, ModuleNotFoundError):
            remedy = f"pip install --force-reinstall {distribution}, or install the system library that the message names"
        without = "a fit needs it" if required else "a fit runs without it"
        return Finding(distribution, MISSING if required else NOTE, f"{_reason(e)} ({use}; {without})", remedy)
    detail = str(getattr(module, "__version__", "of unknown version"))
    if name == "onnxruntime":
        names = [n.removesuffix("ExecutionProvider") for n in module.get_available_providers()]
        detail += f", providers: {', '.join(names)}"
    return Finding(distribution, OK, detail)


def _packages() -> Iterable[Finding]:
    return (_package(*row) for row in PACKAGES)


def _extras() -> Iterable[Finding]:
    lacking = [name for name, (module, _) in EXTRAS.items() if importlib.util.find_spec(module) is None]
    words = [", ".join(name for name in EXTRAS if name not in lacking)]
    words += [f"not installed: {', '.join(f'{name} ({EXTRAS[name][1]})' for name in lacking)}"] if lacking else []
    yield _noted("Extras", not lacking, "; ".join(filter(None, words)), install_extras(*lacking))


def _processor() -> Iterable[Finding]:
    yield Finding("CPU", OK, f"{processor_name()}, {usable_cores()} of {os.cpu_count()} cores usable")
    installed, free = machine_memory()
    detail = f"{format_bytes(installed)}, {format_bytes(free)} available"
    yield _noted("Memory", free >= LOW_MEMORY, detail, "close other programs, or fit at a smaller image size")


def _cuda() -> Iterable[Finding]:
    """Check the CUDA devices; torch and Warp must both see them."""
    slower = "a fit runs on the CPU, slower"
    try:
        import torch
    except Exception as e:
        return [Finding("CUDA", NOTE, f"not checked: {_reason(e)}", "install torch first")]
    if torch.version.cuda is None:
        remedy = "with an NVIDIA GPU: install a CUDA build of torch, see pytorch.org/get-started"
        return [Finding("CUDA", NOTE, f"none: this torch ({torch.__version__}) is built without CUDA; {slower}", remedy)]
    if not torch.cuda.is_available():
        driver = "no NVIDIA driver was found" if shutil.which("nvidia-smi") is None else "torch cannot use the driver"
        remedy = f"install a driver that supports CUDA {torch.version.cuda}"
        if os.environ.get("CUDA_VISIBLE_DEVICES") in ("", "-1"):
            driver, remedy = "CUDA_VISIBLE_DEVICES hides every device", "unset CUDA_VISIBLE_DEVICES"
        return [Finding("CUDA", NOTE, f"none: {driver}; {slower}", f"with an NVIDIA GPU: {remedy}")]
    found = []
    for i in range(torch.cuda.device_count()):
        p = torch.cuda.get_device_properties(i)
        detail = f"{p.name}, {format_bytes(p.total_memory)}, compute {p.major}.{p.minor}, torch for CUDA {torch.version.cuda}"
        found.append(Finding(f"CUDA {i}", OK, detail))
    return [*found, _warp_cuda()]


def _quiet_warp():
    """Return Warp, initialised without its banner and warnings; the report covers them."""
    import warp

    prepare_kernel_cache()
    before = warp.config.log_level
    warp.config.log_level = warp.LOG_ERROR
    try:
        with hidden_stderr():  # native code warns if there is no driver, at any log level
            warp.init()
    finally:
        warp.config.log_level = before
    return warp


def _warp_cuda() -> Finding:
    """Check that Warp finds CUDA devices, and report its driver."""
    try:
        warp = _quiet_warp()
        if warp.is_cuda_available():
            driver = ".".join(map(str, warp.get_cuda_driver_version() or ("unknown",)))
            return Finding("Warp on CUDA", OK, f"{warp.get_cuda_device_count()} devices, driver for CUDA {driver}")
        why = "Warp sees no CUDA device though torch does"
    except Exception as e:
        why = _reason(e)
    return Finding("Warp on CUDA", NOTE, why, "update the NVIDIA driver and warp-lang, or fit with --device cpu")


def _kernel_cache() -> Iterable[Finding]:
    """Check the folder of compiled kernels: without a writable place no kernel runs."""
    topic = "Kernel cache"
    try:
        folder = Path(_quiet_warp().config.kernel_cache_dir)
        refused = prepare_kernel_cache()[1]
    except Exception as e:
        known, remedy = isinstance(e, ResourceError), "set WARP_CACHE_PATH or TMPDIR to a folder that you may write to"
        return [Finding(topic, MISSING, str(e) if known else _reason(e), remedy if known else "fix warp-lang first")]
    if refused:
        remedy = "set WARP_CACHE_PATH to a folder that only you may write to"
        return [Finding(topic, NOTE, f"{refused}; every run compiles its kernels for up to a minute", remedy)]
    first = "" if any(folder.iterdir()) else "; empty: the first fit compiles for up to a minute"
    return [Finding(topic, OK, f"{folder}, writable{first}")]


def _video() -> Iterable[Finding]:
    """Encode a few frames for real: a build of OpenCV may accept the codec and still write nothing."""
    sound, detail = True, "VP9 through OpenCV"
    try:
        import numpy as np

        from warpgs.folders import temporary_folder
        from warpgs.report.film import h264_encoder, write_film

        detail = "H.264 through ffmpeg" if h264_encoder() else detail
        with temporary_folder() as folder:
            write_film(folder.path / "probe.mp4", (np.full((64, 64, 3), level) for level in (0, 0.5, 1)), 10)
    except Exception as e:
        sound, detail = False, f"{_reason(e)}; films are written as single frames"
    remedy = "pip install --force-reinstall opencv-contrib-python-headless (its wheels include the encoder)"
    yield _noted("Film encoder", sound, detail, remedy)


def _disk() -> Iterable[Finding]:
    here = Path.cwd()
    free = shutil.disk_usage(here).free
    remedy = "free some disk space, or work in a folder on another disk"
    yield _noted("Disk", free >= LOW_DISK, f"{format_bytes(free)} free at {here}", remedy)


CHECKS: tuple[Callable[[], Iterable[Finding]], ...] = (
    _python, _packages, _extras, _processor, _cuda, _kernel_cache, _video, _disk,
)  # fmt: skip


def _findings(check: Callable[[], Iterable[Finding]]) -> list[Finding]:
    """Return the findings of a check; a failure of the check is a finding, too."""
    try:
        return list(check())
    except Exception as e:
        topic = check.__name__.strip("_").replace("_", " ").capitalize()
        return [Finding(topic, NOTE, f"the check itself failed: {_reason(e)}", "report this as a bug")]


def diagnose(tell: Say = silent) -> list[Finding]:
    """Check everything that a fit and its report need."""
    return [f for check in counted(CHECKS, tell, "checking this machine", "parts") for f in _findings(check)]


def print_report(findings: list[Finding], console=None) -> int:
    """Print the findings as a table, each with its fix."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = console or Console()
    styles = {OK: "green", NOTE: "yellow", MISSING: "bold red"}
    table = Table(box=SIMPLE_HEAD, pad_edge=False, header_style="bold")
    for name in ("Topic", "Status"):
        table.add_column(name, no_wrap=True)
    table.add_column("Detail, and what to do", overflow="fold")
    for f in findings:
        style, detail = styles[f.status], escape(printable(f.detail))
        fix = f"\n[{style}]fix: {escape(printable(f.remedy))}[/]" if f.status != OK and f.remedy else ""
        table.add_row(escape(f.topic.removesuffix("-python-headless")), f"[{style}]{f.status}[/]", detail + fix)
    console.print(table)
    if stops := [f.topic for f in findings if f.status == MISSING]:
        console.print(f"[bold red]A fit cannot run yet[/]: {escape(', '.join(stops))}.")
        return ResourceError.exit_code
    console.print("[bold green]A fit can run here.[/]")
    return 0


# `warpgs doctor`: check this machine. Parses, calls, prints; no logic.


def run(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` describes it in its help."""

    def doctor(*, warm: bool = False) -> int:
        """Check this machine.

        Args:
            warm: Compile the kernels of fits and of warpgs.compat, for pinhole cameras, and skip the checks.
        """
        if warm:
            with fast_imports():
                from warpgs.pipeline.run.precompile import print_warming
            waiting()("compiling kernels")
            print_warming()
            return 0
        with Stages() as tell, fast_imports():
            findings = diagnose(tell)
        return print_report(findings)

    return call(doctor, arguments, "warpgs doctor", about)
