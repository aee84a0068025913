"""Six frames each of three films in one picture: turntables of two rings of cameras, and that of a forward-facing scene.

usage: python -m bench.film_sheets --ring SCENE --forward SCENE [--preset quick] [--width 256] [--device auto] --out sheet.png

The second ring is the object of `warpgs demo --object`. For each frame the output says how much of it the model covers (mean
alpha), and how much of its middle third: the object must be in every frame.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
from pathlib import Path

import numpy as np
import torch

import warpgs
from warpgs.files import write_bytes
from warpgs.pipeline.films.plan import FilmSettings, plan_film
from warpgs.pipeline.model.model_file import FittedModel
from warpgs.render.rasterize import rasterize
from warpgs.report.images import frame_sheet, png
from warpgs.runtime.terminal import say
from warpgs.synthetic.cut_out import write_object

FRAMES = 6
COVERED = 0.5
"""Alpha above which a pixel shows the model."""


@torch.no_grad()
def frames_of(model: FittedModel, path: str, width: int) -> tuple[list[np.ndarray], str, list[tuple[float, float]]]:
    """Return the frames of a path [H, W, 3], the line that the film prints of it, and shares covered: of all, of the middle."""
    settings = FilmSettings(frames=FRAMES, size=(width, 3 * width // 4))
    plan, options = plan_film(model, path, settings), model.options()
    images, shares = [], []
    for _, c in plan.cameras:
        r = rasterize(model.gaussians(), c, options)
        shown = (r.alpha > COVERED).double().cpu().numpy()
        rows, columns = (slice(n // 3, n - n // 3) for n in shown.shape)
        images.append(r.rgb.clamp(0, 1).cpu().numpy())
        shares.append((float(shown.mean()), float(shown[rows, columns].mean())))
    return images, "; ".join(plan.notes), shares


def main() -> None:
    """Fit three scenes, render their films and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ring", type=Path, required=True)
    parser.add_argument("--forward", type=Path, required=True)
    parser.add_argument("--preset", default="quick")
    parser.add_argument("--width", type=int, default=256)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--out", type=Path, required=True)
    a = parser.parse_args()
    images = []
    with tempfile.TemporaryDirectory() as folder:
        write_object(Path(folder) / "object", views=16, width=a.width, height=3 * a.width // 4)
        scenes = ((a.ring, "turntable"), (Path(folder) / "object", "turntable"), (a.forward, "spiral"))
        for path, film in scenes:
            scene = warpgs.load_scene(path, max_side=a.width)
            model = warpgs.fit(scene, dataclasses.replace(warpgs.PRESETS[a.preset]), device=a.device, verbose=False)
            found, note, shares = frames_of(model, film, a.width)
            images += found
            say(f"{path.name}, {film}: {note}")
            for number, (whole, middle) in enumerate(shares):
                say(f"  frame {number + 1}: {whole:.0%} covered, {middle:.0%} of its middle")
    write_bytes(a.out, png(frame_sheet(images, FRAMES)))
    say(f"{a.out}: {len(images)} frames, a row for each film")


if __name__ == "__main__":
    main()
