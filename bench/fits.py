"""Fits of real scenes from the command line: one row a fit, as its metrics.json has it.

usage: python -m bench.fits DATA [--steps 1000] [--device auto] [--only NAME] --out FILE.json
DATA holds llff/fern, llff/horns, colmap/fern, fox and templeSparseRing. Each is fitted with no flag but split, downscale, steps
and device. Finished rows of FILE.json are kept when the command is given again.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from bench import result_file
from warpgs.pipeline.runs.request import choose_device

SCENES = {
    "llff/fern": ("every:8", 2),
    "llff/horns": ("every:8", 2),
    "colmap/fern": ("every:8", 2),
    "fox": ("every:8", 8),
    "templeSparseRing": ("every:5", 2),
}
"""Split and downscale. templeSparseRing holds one photograph twice (1 and 11): every:5 holds both out, every:8 would train on
a held-out image."""


def fit(folder: Path, split: str, downscale: int, steps: int, device: str) -> dict:
    """Return what the metrics.json of a fit holds.

    Raises:
        CalledProcessError: The fit failed; its messages are on the terminal.
    """
    with tempfile.TemporaryDirectory() as out:
        flags = {"split": split, "downscale": downscale, "steps": steps, "device": device, "out": out}
        words = [str(word) for name, value in flags.items() for word in (f"--{name}", value)]
        subprocess.run([sys.executable, "-m", "warpgs", "fit", str(folder), *words], check=True, stdout=subprocess.DEVNULL)
        return json.loads((Path(out) / "metrics.json").read_text("utf-8"))


def line(row: dict) -> str:
    """Return a row in words."""
    psnr, best = row["test"]["psnr"], max(row["baselines"].values())
    return (
        f"{row['scene']}: held-out PSNR {psnr:.2f} dB ({row['views'][0]['region']}), best baseline {best:.2f} dB, "
        f"{row['gaussians']:,} Gaussians, {row['seconds']['total']:.0f} s"
    )


def main(arguments: list[str] | None = None) -> int:
    """Fit each scene and write its row; return 1 if a fit failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--only", help="a scene's name, or its beginning")
    parser.add_argument("--out", type=Path, required=True)
    a = parser.parse_args(arguments)
    rows = result_file.read(a.out)["rows"] if a.out.is_file() else []
    device, failed = choose_device(a.device)[0], []
    for scene, (split, downscale) in SCENES.items():
        key = {"scene": scene, "split": split, "downscale": downscale, "steps": a.steps}
        if not scene.startswith(a.only or "") or any(key.items() <= row.items() for row in rows):
            continue
        try:
            row = key | fit(a.data / scene, split, downscale, a.steps, a.device)
        except subprocess.CalledProcessError as e:
            failed.append(scene)
            print(f"{scene}: the fit failed with exit code {e.returncode}", file=sys.stderr)
            continue
        rows.append(row)
        print(line(row), flush=True)
        result_file.write(a.out, result_file.result("fits of real scenes: what their metrics.json hold", device, rows))
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
