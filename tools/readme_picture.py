"""The first picture of the README: photographs of a synthetic object, beside a render of their fit from another direction.

`python -m tools.readme_picture FOLDER --out docs/images/eight-photographs.webp` writes scene and run into FOLDER. If FOLDER
has a run, only the picture is made. Prints the held-out PSNR and the size of the file.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

import warpgs
from warpgs.synthetic.demo import write_object

SIDE = 640
"""Width and height of photographs and render [px]."""
COLUMNS, ROWS, GAP = 2, 4, 8
"""The grid of photographs at the left, and the gap to the render [px]."""
SHOWN = "images/010.png"
"""The rendered view, a held-out one."""


def picture(photographs: list[np.ndarray], render: np.ndarray) -> Image.Image:
    """Return the photographs in a grid, reduced to its cells, beside the render; all are [H, W, 3], in [0, 1]."""
    images = [Image.fromarray(np.uint8(255 * np.clip(image, 0, 1) + 0.5)) for image in (*photographs, render)]
    cell = SIDE // ROWS
    sheet = Image.new("RGB", (COLUMNS * cell + GAP + SIDE, SIDE), "white")
    for i, image in enumerate(images[:-1]):
        sheet.paste(image.reduce(ROWS), (i % COLUMNS * cell, i // COLUMNS * cell))
    sheet.paste(images[-1], (COLUMNS * cell + GAP, 0))
    return sheet


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder of scene and run")
    parser.add_argument("--out", type=Path, required=True, help="picture to write")
    a = parser.parse_args(arguments)
    scene, run = a.folder / "scene", a.folder / "run"
    if not run.exists():
        split = write_object(scene, width=SIDE, height=SIDE)
        result = warpgs.fit(warpgs.load_scene(scene), "default", split=split, out=run)
        print(f"held-out PSNR {result.metrics['test']['psnr']:.2f} dB")
    model, views = warpgs.open_run(run), {view.name: view for view in warpgs.load_scene(scene).views}
    photographs = [views[name].image + 1 - views[name].alpha[..., None] for name in model.train]  # over white
    options = replace(model.options(), background=(1.0, 1.0, 1.0))
    render = warpgs.rasterize(model.gaussians(), views[SHOWN].camera, options).rgb
    picture(photographs, render.numpy(force=True)).save(a.out, quality=88, method=6)
    print(f"{a.out}: {a.out.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
