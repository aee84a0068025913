"""The bits that a fit gives on this processor: the SHA-256 of every stage from photographs to PLY, beside other processors.

Prints a line for each stage of `bench.lib.same_bits` with the first 12 digits of its SHA-256. Writes a row into the result
``--out``, replacing a row with the same label, processor and arguments. Names the stages that differ from the first row with
the same arguments and kind of device. ``--avx2``: every library uses its code for processors without AVX-512, and Warp compiles
for Haswell. ``--starts``: each fit stops before its first step. ``--scene``: a demo with these views and this size that `warpgs
demo` wrote on another machine.
"""

from __future__ import annotations

import importlib.metadata
import os
import platform
import subprocess
import sys
from pathlib import Path

import torch
import warp

from bench.lib import result_file
from bench.lib.arguments import parse
from bench.lib.same_bits import RESULTS, differing, placed, stages
from warpgs.kernels.launch import set_threads
from warpgs.kernels.native import EXACT, ROLLED

WHAT = "SHA-256, first 12 digits, of every stage from photographs to the PLY of a fit, and of single library functions"
AVX2 = {
    "ATEN_CPU_CAPABILITY": "avx2",
    "MKL_ENABLE_INSTRUCTIONS": "AVX2",
    "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",
    "OPENBLAS_CORETYPE": "Haswell",
    "OPENCV_CPU_DISABLE": "AVX512-SKX",
    "OPENCV_IPP": "avx2",
}
"""Environment variables that make libraries use their code for processors without AVX-512."""
VARIABLES = (*AVX2, "MKL_CBWR", "GLIBC_TUNABLES")
"""All variables of that kind that a row records."""
FEATURES = ("sse4_2", "avx", "fma", "avx2", "avx512f", "avx512_bf16", "avx512_fp16", "amx_tile")


def _features() -> list[str]:
    """Return the relevant vector extensions by their names in the Linux kernel; none if these are unknown."""
    try:
        flags = next(line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("flags")).split()
    except (OSError, StopIteration):
        return []
    return [f for f in FEATURES if f in flags]


def _versions() -> dict[str, str]:
    """Return the versions of further libraries that affect bits."""
    names = ("numpy", "opencv-contrib-python-headless")
    found = {n: importlib.metadata.version(n) for n in names}
    return found | {"libc": " ".join(platform.libc_ver())}


def row(device: torch.device, label: str, arguments: dict, given: Path | None) -> dict:
    """Return one row of the table: the machine, the settings that select its code, and the digest of each stage."""
    head = result_file.result(WHAT, device, [])
    kept = {name: head[name] for name in ("command", "commit", "date", "machine", "versions")}
    record = {"label": label, "arguments": arguments} | kept | {
        "features": _features(), "torch_capability": torch.backends.cpu.get_cpu_capability(),
        "warp_flags": warp.config.cpu_compiler_flags,
        "environment": {n: os.environ[n] for n in VARIABLES if n in os.environ},
    }  # fmt: skip
    record["versions"] |= _versions()
    found = {}
    for name, value in stages(device, **arguments, given=given):
        found[name] = value
        print(f"{value}  {name}")
    return record | {"stages": found}


def _set_threads(count: int) -> None:
    """Let torch, our kernels and OpenCV use so many threads, as on a machine with so many cores."""
    import cv2

    set_threads(count)
    cv2.setNumThreads(count)


def _compile_for(target: str) -> None:
    """Let Warp compile further CPU kernels for a processor other than this one."""
    flag = f"-target-cpu {target}"
    warp.config.cpu_compiler_flags = warp.config.cpu_compiler_flags.replace("-march=native", flag)
    for options in (EXACT, ROLLED):
        options["cpu_compiler_flags"] = options["cpu_compiler_flags"].replace("-march=native", flag)


def main() -> None:
    """Parse, compute, compare, write."""
    a = parse(
        __doc__, out=RESULTS, device="cpu", threads=0, steps=60, views=8, size=[240, 180], scene=Path, avx2=False, starts=False,
        label="as it is",
    )  # fmt: skip
    if a.avx2 and any(os.environ.get(n) != v for n, v in AVX2.items()):
        # libraries read these when they are loaded
        again = subprocess.run(
            [sys.executable, "-m", "bench.fits.same_bits", *sys.argv[1:]], env=os.environ | AVX2, check=False
        )
        sys.exit(again.returncode)
    if a.avx2:
        _compile_for("haswell")
    if a.threads:
        _set_threads(a.threads)
    arguments = {"views": a.views, "width": a.size[0], "height": a.size[1], "steps": a.steps, "only_start": a.starts}
    made = row(torch.device(a.device), a.label, arguments, a.scene)
    rows = placed(result_file.read(a.out)["rows"] if a.out.exists() else [], made)
    first = next(r for r in rows if r["arguments"] == arguments and r["machine"]["device"] == a.device)
    if first is not made:
        others = ", ".join(differing(made, first)) or "none"
        print(f"of {len(made['stages'])} stages these differ from {first['machine']['name']}, {first['label']}: {others}")
    result_file.keep(a.out, WHAT, torch.device(a.device), rows)


if __name__ == "__main__":
    main()
