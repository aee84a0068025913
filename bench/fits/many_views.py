"""A fit of many photographs: the demo with 300 views, its time, steps, PSNR and peak memory.

Each fit has its own process, so that peak memory is measured per fit; it includes reading the scene.
"""

from __future__ import annotations

import functools
import re
import sys
import tempfile
import time
from pathlib import Path

import warpgs
from bench.lib import result_file
from bench.lib.arguments import parse
from bench.lib.one_fit import compile_all, config_of, figures_of
from bench.lib.pool import finished
from bench.lib.tables import named
from warpgs.pipeline.run.request import SceneRequest, choose_device
from warpgs.synthetic.demo import write_demo

WHAT = "fits of a demo of many views: time, steps, PSNR and peak memory"


def peak_resident() -> int:
    """Return the peak memory of this process [bytes] (Linux); getrusage would include that of the parent process."""
    return 1024 * int(re.search(r"VmHWM:\s*([0-9]+) kB", Path("/proc/self/status").read_text("ascii"))[1])


def fit_in_new_process(task: tuple[str, str, str, int, str]) -> dict:
    """Fit (folder, split, preset, seed, device) and return its figures, with the peak memory of this process [bytes]."""
    folder, split, preset, seed, device = task
    config, began = config_of(preset, seed), time.perf_counter()
    metrics = warpgs.fit(SceneRequest(folder, split, downscale=1), config, device=device, verbose=False).metrics
    wall = time.perf_counter() - began
    views = metrics["protocol"]["training_views"]
    return {"seed": seed, "training_views": views, "wall": wall, "peak_rss_bytes": peak_resident()} | figures_of(metrics)


def _compiled(first) -> dict:
    first()
    return {}


def main(arguments: list[str] | None = None) -> int:
    """Make the demo, fit it, print and keep the figures; return 1 if a fit failed."""
    a = parse(
        __doc__, arguments, need=("out",), views=300, width=320, height=240, seeds=1, split="every:8", preset="default",
        device="auto", work=Path, out=Path,
    )  # fmt: skip
    device, rows = choose_device(a.device)[0], []
    facts = {k: getattr(a, k) for k in ("views", "width", "height", "split", "preset")}
    with tempfile.TemporaryDirectory() as work:
        folder = (a.work or Path(work)) / f"demo{a.views}_{a.width}x{a.height}"
        if not folder.is_dir():
            write_demo(folder, views=a.views, width=a.width, height=a.height)
        first = functools.partial(compile_all, (a.preset,), str(device))
        for seed in range(a.seeds):
            # compiled in another process: its memory is not the fit's
            list(finished(_compiled, [first], 1, float("inf")))
            task = (str(folder), a.split, a.preset, seed, str(device))
            rows += [{"seed": seed} | row for _, row in finished(fit_in_new_process, [task], 1, float("inf"))]
            print(named(rows[-1]), flush=True)
            result_file.keep(a.out, WHAT, device, rows, **facts)
    return int(any("error" in row for row in rows))


if __name__ == "__main__":
    sys.exit(main())
