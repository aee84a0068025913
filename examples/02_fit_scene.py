"""Load a scene, fit it, render it from new viewpoints, and save the model.

    python examples/02_fit_scene.py path/to/scene --out result

The scene is a folder of images with cameras (COLMAP, transforms.json, LLFF, DTU or Middlebury). Without a scene, a synthetic
one is written and fitted. Prints the held-out PSNR; writes a turntable as images and film, the PLY file for viewers, and the
model.
"""

import argparse
import dataclasses
from pathlib import Path

import warpgs


def main(arguments: list[str] | None = None) -> float:
    """Run the example; return the gain in held-out PSNR over the mean training image [dB]."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, nargs="?", help="scene folder; default: a synthetic scene")
    parser.add_argument("--out", type=Path, default=Path("result"), help="folder to write")
    parser.add_argument("--steps", type=int, default=300, help="optimisation steps")
    parser.add_argument("--frames", type=int, default=24, help="frames of the film")
    parser.add_argument("--width", type=int, default=96, help="width of the synthetic images [px]")
    a = parser.parse_args(arguments)

    split = "every:8"
    if a.scene is None:
        a.scene = a.out / "scene"
        split = warpgs.write_demo(a.scene, views=9, width=a.width, height=3 * a.width // 4)

    scene = warpgs.load_scene(a.scene)
    config = dataclasses.replace(warpgs.PRESETS["quick"], steps=a.steps)
    result = warpgs.fit(scene, config, split=split, on_step=lambda report: None)

    files = warpgs.render_path(result, "turntable", out=a.out / "turntable", frames=a.frames)
    # a fit works in scene units; files for other programs have the units of the scene's files
    warpgs.write_ply(a.out / "scene.ply", result.gaussians("file"), units="file")
    warpgs.save(a.out / "model.safetensors", result.gaussians(), result.normalization, units="scene")
    again = warpgs.load(a.out / "model.safetensors").gaussians("file")
    moved = (again.means - warpgs.read_ply(a.out / "scene.ply").means).abs().max()

    gain = float(result.metrics["test"]["psnr"] - result.metrics["baselines"]["mean_photo"])
    print(f"held-out PSNR {result.metrics['test']['psnr']:.2f} dB, {gain:+.2f} dB over the mean training image")
    print(
        f"{len(files)} files of a turntable in {a.out / 'turntable'}; model and PLY agree within {float(moved):.1g} file units"
    )
    return gain


if __name__ == "__main__":
    main()
