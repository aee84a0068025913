"""A fit of many photographs: the demo with 300 views, its time, steps, PSNR and peak memory.

usage: python -m bench.many_views [--views 300] [--width 320] [--height 240] [--split every:8] [--preset default] [--seeds 1]
           [--device auto] [--work FOLDER] --out FILE.json
Each fit has a process of its own, so that its peak memory is its own; reading the scene counts as part of it.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import re
import sys
import tempfile
import time
from pathlib import Path

import torch

import warpgs
from bench import result_file
from bench.one_fit import compile_all, config_of, figures_of
from bench.pool import finished
from warpgs.pipeline.runs.request import SceneRequest, choose_device
from warpgs.synthetic.demo import write_demo

WHAT = "fits of a demo of many views: time, steps, PSNR and peak memory"


def peak_resident() -> int:
    """Return the most memory that this process has held [bytes] (Linux); getrusage would count its parent's, too."""
    return 1024 * int(re.search(r"VmHWM:\s*([0-9]+) kB", Path("/proc/self/status").read_text("ascii"))[1])


def fit_in_new_process(task: tuple[str, str, str, int, str]) -> dict:
    """Fit (folder, split, preset, seed, device) and return its figures, with the peak memory of this process [bytes]."""
    folder, split, preset, seed, device = task
    config = dataclasses.replace(config_of(preset, torch.device(device)), seed=seed)
    began = time.perf_counter()
    metrics = warpgs.fit(SceneRequest(folder, split, 1), config, device=device, verbose=False).metrics
    wall = time.perf_counter() - began
    views = metrics["protocol"]["training_views"]
    return {"seed": seed, "training_views": views, "wall": wall, "peak_rss_bytes": peak_resident()} | figures_of(metrics)


def line(row: dict) -> str:
    """Return a row in words."""
    if "error" in row:
        return f"failed: {row['error']}"
    torch_peak = f", {row['peak_torch_bytes'] / 2**30:.2f} GiB of the device" if "peak_torch_bytes" in row else ""
    return (
        f"{row['training_views']} training views: {row['wall']:.1f} s (setup {row['setup']:.1f}, "
        f"training {row['training']:.1f}), "
        f"{row['steps']} steps, {row['psnr']:.2f} dB, SSIM {row['ssim']:.4f}, {row['gaussians']:,} Gaussians, "
        f"{row['peak_rss_bytes'] / 2**30:.2f} GiB resident{torch_peak}; {row['ended'] or row['why']}"
    )


def main(arguments: list[str] | None = None) -> int:
    """Make the demo, fit it, print and keep the figures; return 1 if a fit failed."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, value in (("views", 300), ("width", 320), ("height", 240), ("seeds", 1)):
        p.add_argument(f"--{name}", type=int, default=value)
    p.add_argument("--split", default="every:8")
    p.add_argument("--preset", default="default")
    p.add_argument("--device", default="auto")
    p.add_argument("--work", type=Path, help="folder that keeps the demo for the next call; a temporary one where not given")
    p.add_argument("--out", type=Path, required=True)
    a = p.parse_args(arguments)
    device, rows = choose_device(a.device)[0], []
    facts = {k: getattr(a, k) for k in ("views", "width", "height", "split", "preset")}
    with tempfile.TemporaryDirectory() as work:
        folder = str((a.work or Path(work)) / f"demo{a.views}_{a.width}x{a.height}")
        if not Path(folder).is_dir():
            write_demo(Path(folder), views=a.views, width=a.width, height=a.height)
        first = functools.partial(compile_all, (a.preset,), str(device))
        for seed in range(a.seeds):
            # compiled in another process: its memory is not the fit's
            for _ in finished(_compiled, [first], 1, float("inf")):
                pass
            for _, row in finished(fit_in_new_process, [(folder, a.split, a.preset, seed, str(device))], 1, float("inf")):
                rows.append({"seed": seed} | row)
                print(line(rows[-1]), flush=True)
                result_file.write(a.out, result_file.result(WHAT, device, rows, **facts))
    return int(any("error" in row for row in rows))


def _compiled(first) -> dict:
    first()
    return {}


if __name__ == "__main__":
    sys.exit(main())
