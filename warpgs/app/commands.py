"""Commands: each is a function whose arguments are its flags and whose docstring is its help; it calls and prints, no logic."""

import shlex
from collections.abc import Callable
from dataclasses import dataclass, field, make_dataclass
from math import radians
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg  # noqa: TID253 - flags are annotations, and only a command imports this file

from warpgs.app.flags import Port, Threads, call, listed
from warpgs.errors import UsageError
from warpgs.io.image_files import MAX_PIXELS
from warpgs.process import say, say_lines
from warpgs.report.progress import Stages, waiting
from warpgs.schema import Checked, Within

Side = Annotated[int, Within(32, 8192)]
"""Side of a synthetic image [px]."""
Pixels = Annotated[int, Within(1, 2**40)]
"""Number of pixels of an image."""


def demo(
    folder: Positional[Path], *, views: Annotated[int, Within(8, 10_000)] = 24, width: Side = 320, height: Side = 240,
    seed: Annotated[int, Within(0, 2**31 - 1)] = 0, object: bool = False, format: Literal["transforms", "colmap"] | None = None,
) -> None:  # fmt: skip
    """Write a synthetic scene.

    Args:
        folder: Folder to write; new or empty.
        views: Number of photographs.
        width: Image width [px].
        height: Image height [px].
        seed: Seed of the textures, and of the shape of an object.
        object: Write a single object instead of a still life; eight of the views are for training.
        format: Format of --object: transforms (transforms.json with RGBA images; default) or colmap (RGB images with masks).
    """
    if format is not None and not object:
        raise UsageError("--format requires --object: the still life is always written as COLMAP")
    from warpgs.synthetic.demo import write_demo, write_object

    sizes = {"views": views, "width": width, "height": height, "seed": seed}
    if object:
        write_object(folder, form=format or "transforms", **sizes, tell=waiting())
        flags = "--split llff:8" + (" --masks cutout" if format == "colmap" else "")
    else:
        write_demo(folder, **sizes, tell=waiting())
        flags = "--split every:8"
    form = "transforms.json" if object and format != "colmap" else "COLMAP"
    say(f"{folder}: {views} views of {width} x {height} px as a {form} folder")
    say(f"next: warpgs fit {shlex.quote(str(folder))} {flags} --out run")


def poses(
    photographs: Positional[Path], *, out: Path, frames: Annotated[int | None, Within(3, 1000)] = None, threads: Threads = 0,
    max_pixels: Pixels = MAX_PIXELS, allow_outside: bool = False, matcher: Path | None = None,
) -> None:  # fmt: skip
    """Find the poses of photographs or of a video.

    Args:
        photographs: Folder of photographs, or a video file.
        out: Scene folder to write; new or empty.
        frames: Frames to take from a video, evenly spaced and sharp. Default: 60.
        threads: CPU threads; 0 for as many as there are cores.
        max_pixels: Largest number of pixels that an image may have.
        allow_outside: Allow links to photographs outside the folder.
        matcher: ONNX file of `warpgs priors export --model xfeat`; finds matches where SIFT leaves photographs without a pose.
    """
    from warpgs.poses.find import FRAMES, TEXT, find_poses, report_lines

    frames = FRAMES if frames is None else frames
    record = find_poses(
        photographs, out, frames=frames, threads=threads, max_pixels=max_pixels, allow_outside=allow_outside, matcher=matcher,
        progress=Stages(),
    )  # fmt: skip
    say_lines(report_lines(record))
    say(f"{out}: a COLMAP scene; the lines above are also in {out / TEXT}")
    say(f"next: warpgs fit {shlex.quote(str(out))} --out run")


def view(run: Positional[Path], *, port: Port = 8080, device: str = "auto", reader: str | None = None) -> None:
    """Look at a model in a browser.

    Args:
        run: Run folder of `warpgs fit`, also during the fit; or a file of Gaussians, in a format of `warpgs convert`.
        port: Port of the viewer on this machine; 0 for any free one.
        device: Device that renders depth, coverage and error: auto, cpu or cuda.
        reader: User-defined reader, as for `warpgs fit --reader`.
    """
    from warpgs.viewer.watch import view as show

    show(run, port, device, reader)


def render(
    run: Positional[Path], *, cameras: Path | None = None, rule: str | None = None, antialiased: bool = False,
    path: str = "auto", out: Path | None = None, seconds: float | None = None, fps: Annotated[int, Within(1, 1000)] = 30,
    frames: int | None = None, size: tuple[int, int] | None = None, fov: float | None = None, background: str = "auto",
    sheet: bool = False, device: str = "auto", coverage: bool = False, near: Annotated[float | None, Within(0, 1e9)] = None,
) -> list[str]:  # fmt: skip
    """Render a run or a file of Gaussians.

    Args:
        run: Run folder of `warpgs fit`, or a file of Gaussians from any program, in a format of `warpgs convert`.
        cameras: Cameras for a file of Gaussians: cameras.json, transforms.json, a COLMAP folder, or a scene.
        rule: Cut-offs with which a file of Gaussians was trained: inria, gsplat-1.6, gsplat-1.5 or exact. Default: exact for
            files that name warpgs, else inria.
        antialiased: Render a file of Gaussians with antialiasing. Needed for antialiased models (gsplat's rasterize_mode
            antialiased) if the file does not declare this.
        path: auto (chosen from the cameras), turntable, spiral, interpolate (through the training views), views (every view of
            the scene), or a .json file of keyframes.
        out: Folder for the images and film.mp4; or a file for the film alone: .mp4, .webm, .webp or .gif. Existing files are
            replaced. Default: path-PATH in the run folder, or beside the file of Gaussians.
        seconds: Duration of the film [s]. Default: chosen by the path.
        fps: Frames per second of the film.
        frames: Number of frames. Default: seconds times fps.
        size: Width and height of the frames [px], such as 1080 1920 or 1080x1920. Default: those of the photographs.
        fov: Vertical field of view [deg]. Default: that of the photographs, or less where --size has another shape.
        background: auto (the fit's colour; images of cut-out objects are transparent PNGs), black, white, #rrggbb or r,g,b in
            [0, 1].
        sheet: Also write six frames in one image: sheet.png.
        device: auto, cpu or cuda.
        coverage: Also write images of the coverage by training views, into the subfolder coverage.
        near: Nearest depth that is rendered of a file of Gaussians, in its units. Default: that of the rule (inria: 0.2).
    """
    if run.is_dir() and (cameras is not None or rule is not None or antialiased or near is not None):
        raise UsageError("--cameras, --rule, --antialiased and --near are for files of Gaussians; leave them out for a run")
    from warpgs.pipeline.films.film import FilmSettings
    from warpgs.pipeline.run import commands

    settings = FilmSettings(frames, seconds, fps, size, None if fov is None else radians(fov))
    return commands.render(
        run, path, out, settings, device, background=background, coverage=coverage, sheet=sheet,
        file_of=(cameras, rule) if run.is_file() or cameras is not None else None, antialiased=antialiased,
        near=near,
    )  # fmt: skip


def plot(
    run: Positional[Path], *, out: Path | None = None, points: Literal["gaussians", "start"] = "gaussians",
    color: Literal["own", "coverage"] = "own", background: Literal["white", "black"] = "white",
    size: tuple[int, int] = (1600, 1000), cameras: bool = True, device: str = "auto",
) -> list[str]:  # fmt: skip
    """Plot a run's cameras and Gaussians.

    Args:
        run: Run folder of `warpgs fit`.
        out: PNG file to write. Default: plot.png in the run folder.
        points: gaussians, or start (the points of the scene's reconstruction).
        color: own (colour of the Gaussian or point), or coverage (how many training views see each Gaussian).
        background: white or black.
        size: Width and height [px].
        cameras: Show the cameras.
        device: auto, cpu or cuda.
    """
    from warpgs.pipeline.run import commands

    return commands.plot(run, out, device, points=points, color=color, background=background, size=size, cameras=cameras)


def mesh(
    run: Positional[Path], *, out: Path, voxel: float | None = None, resolution: int | None = None, max_faces: int = 200_000,
    depth: str = "median", crop: str | None = None, fill_holes: bool = False, device: str = "auto",
) -> list[str]:  # fmt: skip
    """Make a mesh of a run.

    Args:
        run: Run folder of `warpgs fit`.
        out: File to write: .ply (colours at the vertices), or .glb (glTF; with a texture if pixels are finer than triangles).
        voxel: Side of a voxel, in units of the run's files; smaller voxels show more detail and more noise.
        resolution: Voxels along the longest side of the mesh, instead of --voxel. Default: 256, or fewer for small images.
        max_faces: Largest number of triangles; larger meshes are simplified.
        depth: Rendered depth to fuse: median, or mean, which is less accurate at edges.
        crop: auto (the surfaces that at least a third of the training cameras look at), or a box as for `warpgs export --crop`.
        fill_holes: Fill holes: with depths that are uncertain or that only one view sees, and small ones with flat triangles.
        device: auto, cpu or cuda.
    """
    from warpgs.mesh.fuse import MeshOptions
    from warpgs.pipeline.run import export

    options = MeshOptions(voxel, resolution, max_faces, depth, fill_holes=fill_holes)
    return export.mesh(run, out, options, device, crop=crop, stage=Stages(), say=say)


def level(
    run: Positional[Path], *, scale: tuple[str, ...] | None = None, ground: tuple[str, ...] | None = None,
    up: Literal["photographs"] | None = None, gps: tuple[Path, ...] | None = None, device: str = "auto",
) -> list[str]:  # fmt: skip
    """Give a run's files real sizes.

    Args:
        run: Run folder of `warpgs fit`; its PLY is written again, and every later export has the new coordinates.
        scale: Such as a.jpg:410,220 b.jpg:95,310 1.2: two points, and the length between them, in metres, or such as 20cm.
            A point is VIEW:X,Y (a pixel of a photograph at the size of the fit) or X,Y,Z (coordinates in the run's files).
            More lengths, in the same option, make it surer.
        ground: Three points of the ground, which becomes level, or more, which make it surer.
        up: photographs, to level by how the photographs were held.
        gps: Metres to east, north and up by the GPS in EXIF, of the scene's photographs or of those in a folder.
        device: auto, cpu or cuda.
    """
    from warpgs.pipeline.run import level as levels

    return levels.level(run, device, scale, ground, up is not None, gps)


def prune(
    run: Positional[Path], *, keep_psnr: float | None = None, clean: str | None = None, out: Path | None = None,
    device: str = "auto", reader: str | None = None,
) -> list[str]:  # fmt: skip
    """Shrink a finished model, or clean it up.

    Args:
        run: Run folder of `warpgs fit`; it is not changed.
        keep_psnr: Largest drop of the mean PSNR over the training views [dB]; 0.1 without --clean.
        clean: Remove floaters instead: all, or some of opacity,unseen,size,needles,distance,density; show (write clean.png
            into the run, which shows what would go).
        out: Run folder to write; must not exist yet. Default: RUN-pruned.
        device: auto, cpu or cuda.
        reader: User-defined reader, as for `warpgs fit --reader`.
    """
    from warpgs.pipeline.run import commands

    if clean is None:
        return commands.prune(run, 0.1 if keep_psnr is None else keep_psnr, out, device, reader, Stages())
    if keep_psnr is not None:
        raise UsageError("--keep-psnr and --clean: give one of the two; a run that one of them made can be given to the other")
    return commands.clean(run, clean, out, device, reader, Stages())


def evaluate(
    run: Positional[Path], *, device: str = "auto", lpips_weights: Path | None = None, reader: str | None = None,
    by_coverage: bool = False,
) -> list[str]:  # fmt: skip
    """Score a run again.

    Args:
        run: Run folder of `warpgs fit`.
        device: auto, cpu or cuda.
        lpips_weights: File of `warpgs convert-lpips`; without it LPIPS is not measured.
        reader: User-defined reader, as for `warpgs fit --reader`.
        by_coverage: Split the scores by the number of training views that saw each pixel's surface: none, one, two or more.
    """
    from warpgs.pipeline.run import commands

    return commands.evaluate(run, device, lpips_weights, reader, by_coverage)


def convert_lpips(*, backbone: Path, heads: Path, out: Path) -> list[str]:
    """Join published LPIPS weights.

    Args:
        backbone: torchvision's state dict of vgg16 or alexnet (.pth).
        heads: vgg.pth or alex.pth of PerceptualSimilarity, folder lpips/weights/v0.1.
        out: File to write (.safetensors).
    """
    from warpgs.pipeline.metrics import lpips

    return lpips.convert_lpips(backbone, heads, out)


COMMANDS: dict[str, Callable[..., Any]] = {
    "demo": demo, "poses": poses, "view": view, "render": render, "plot": plot, "mesh": mesh, "level": level,
    "prune": prune, "eval": evaluate, "convert-lpips": convert_lpips,
}  # fmt: skip
"""Commands with the same flags at every call."""


def run(name: str, arguments: list[str], about: str) -> int:
    """Run a command, print the lines that it returns, and return its exit code; ``about`` describes it in its help."""
    if name == "priors":
        if arguments[:1] in (["-h"], ["--help"], ["--help-all"]):
            say_lines((f"warpgs priors: {about}", "", *PRIORS))
            return 0
        if arguments[:1] not in (["show"], ["export"]):
            raise UsageError("priors: give show or export; `warpgs priors --help` shows how")
        command, about = show_priors() if arguments[0] == "show" else export_network()
        name, arguments = f"priors {arguments[0]}", arguments[1:]
    elif name in COMMANDS:
        command = COMMANDS[name]
    else:
        command, more = {"export": export, "convert": convert, "compare": compare, "ablate": ablate}[name](arguments)
        about = f"{about}\n\n{more}"
    say_lines(call(command, arguments, f"warpgs {name}", about) or ())
    return 0


# Commands whose flags depend on the words of the command line, or on modules that take long to import. Each function
# returns the command and a text for its help.

PRIORS = (
    "usage: warpgs priors show SCENE --out DIR [flags]",
    "       warpgs priors export --model MODEL --out FILE.onnx [flags]",
    "",
    "`warpgs priors show --help` and `warpgs priors export --help` list their flags.",
)
Command = tuple[Callable[..., Any], str]


def show_priors() -> Command:
    """Return `warpgs priors show`."""
    from warpgs.pipeline.run import commands
    from warpgs.pipeline.run.request import SceneRequest
    from warpgs.priors.views import PriorConfig

    def show(
        scene: Positional[Path], *, out: Path, split: str | None = None, downscale: int | None = None,
        max_side: int | None = None, allow_outside: bool = False, max_pixels: Pixels = MAX_PIXELS, threads: Threads = 0,
        source: Literal["sweep", "flow"] = "sweep", priors: OmitArgPrefixes[PriorConfig],
    ) -> list[str]:  # fmt: skip
        """Write depth and saliency.

        Args:
            scene: Scene folder.
            out: Folder for PNG sheets, one for each training view.
            split: Split, as for `warpgs fit`.
            downscale: Factor by which both image sides shrink; if given, --max-side has no default limit.
            max_side: Largest image side [px], 0 for no limit. Default: 1600 without --downscale.
            allow_outside: Allow names and links that point to files outside the scene folder.
            max_pixels: Largest number of pixels that an image or a mask may have as stored.
            threads: CPU threads of the networks; 0 for as many as there are cores.
            source: Method of depth estimation without a network: sweep or flow, as for --init.source of a fit.
            priors: Networks.
        """
        sizes = {"downscale": downscale, "max_side": max_side, "max_pixels": max_pixels}
        request = SceneRequest(str(scene), split, allow_outside=allow_outside, **sizes)
        return commands.show_priors(request, priors, source, out, threads)

    return show, "write depth and saliency of each training view as images"


def export_network() -> Command:
    """Return `warpgs priors export`."""
    from warpgs.priors import export as networks

    def write(request: OmitArgPrefixes[networks.ExportRequest], *, out: Path) -> list[str]:
        """Write a network.

        Args:
            request: The network.
            out: ONNX file to write; FILE.onnx.json beside it describes its input.
        """
        return networks.export_network(request, out)

    return write, "write a network as an ONNX file"


def export(arguments: list[str]) -> Command:
    """Return `warpgs export`."""
    from warpgs.app.format_flags import chosen_formats, filters_of, format_flags, format_lines

    def write(
        run: Positional[Path], *, to: Path, keep_names: bool = False, flags: Annotated[format_flags(arguments), arg(name="")]
    ) -> list[str]:
        """Write a run's Gaussians or cameras.

        Args:
            run: Run folder of `warpgs fit`.
            to: File to write; its suffix chooses the format. For cameras: cameras.json, transforms.json, or sparse (COLMAP).
            keep_names: Name the images of cameras as the photographs, not by numbers.
            flags: Filters and options of formats.
        """
        formats, filters = chosen_formats(flags, to), filters_of(flags)
        waiting()(f"writing {to.name}")
        if to.suffix.lower() == ".html" and not formats and not keep_names:
            from warpgs.viewer.html import export_html

            return export_html(run, to, filters)
        from warpgs.pipeline.run import export

        return export.export(run, to, filters, formats[0] if formats else None, keep_names)

    return write, f"{format_lines()}\n  .html: a page that shows the model in any browser"


def convert(arguments: list[str]) -> Command:
    """Return `warpgs convert`."""
    from warpgs.app.format_flags import chosen_formats, filters_of, format_flags, format_lines

    def write(
        source: Positional[Path], target: Positional[Path], flags: Annotated[format_flags(arguments), arg(name="")]
    ) -> list[str]:
        """Write a file of Gaussians or cameras in another format.

        Args:
            source: File of Gaussians to read; or cameras: cameras.json, transforms.json, or a COLMAP folder.
            target: File to write. For cameras: cameras.json, transforms.json, or sparse (COLMAP).
            flags: Filters and options of formats.
        """
        from warpgs.pipeline.run import export

        waiting()(f"writing {target.name}")
        return export.convert(source, target, filters_of(flags), chosen_formats(flags, target))

    return write, format_lines()


def study_flags() -> type:
    """Return the dataclass of the flags that `compare` and `ablate` share."""
    from warpgs.app.fit import scene_flags

    reading, unread = scene_flags(positional=False)

    @dataclass(frozen=True, kw_only=True)
    class Study(Checked, group="--"):
        scenes: Positional[tuple[Path, ...]]
        """Scene folders."""
        out: Path
        """Folder of the study; repeat the command to continue an interrupted study."""
        seeds: int = 5
        """Number of runs of each setting on each scene; seeds count from 0."""
        steps: int | None = None
        """Optimisation steps of every run. Default: as in `warpgs fit`."""
        device: str = "auto"
        """auto, cpu or cuda."""
        slots: Annotated[int | None, Within(1)] = None
        """Number of concurrent runs, each in its own process. If neither --slots nor --per-gpu is given, runs follow each other
        in one process."""
        per_gpu: Annotated[int | None, Within(1)] = None
        """Runs that share a GPU."""
        lpips_weights: Path | None = None
        """File of `warpgs convert-lpips`; without it LPIPS is not measured."""

    hint = OmitArgPrefixes[reading]
    return make_dataclass("Study", [("reading", hint, field(default=unread))], bases=(Study,), frozen=True, kw_only=True)


def run_study_of(a: Any, variants: dict, marks: dict) -> list[str]:
    """Run the study of parsed flags; return lines for the user."""
    from warpgs.app.fit import scene_of
    from warpgs.pipeline.study.study import StudyRequest, run_study

    scenes = tuple(scene_of(a.reading, str(s)) for s in a.scenes)
    engine = {n: v for n in ("slots", "per_gpu") if (v := getattr(a, n)) is not None} or None
    return run_study(StudyRequest(scenes, variants, a.seeds, a.out, a.device, a.lpips_weights, engine, marks))


def compare(arguments: list[str]) -> Command:
    """Return `warpgs compare`."""
    from warpgs.pipeline.study.study import preset_variants
    from warpgs.pipeline.train.presets import PRESETS

    def study(flags: OmitArgPrefixes[study_flags()], *, presets: str = ",".join(PRESETS)) -> list[str]:
        """Fit presets to scenes.

        Args:
            flags: Scenes and runs.
            presets: Presets as for `warpgs fit --preset`, separated by commas; the others are compared with the first.
        """
        return run_study_of(flags, preset_variants([n.strip() for n in presets.split(",") if n.strip()], flags.steps), {})

    return study, listed("presets", PRESETS.described())


def ablate(arguments: list[str]) -> Command:
    """Return `warpgs ablate`."""
    from warpgs.pipeline.study.study import ablation_variants, preset_variants
    from warpgs.pipeline.train.presets import DEFAULT_PRESET, PRESETS

    def study(flags: OmitArgPrefixes[study_flags()], *, preset: str = DEFAULT_PRESET) -> list[str]:
        """Fit a preset with one part changed at a time.

        Args:
            flags: Scenes and runs.
            preset: Preset, as for `warpgs fit --preset`; one part is changed at a time.
        """
        (config,) = preset_variants([preset], flags.steps).values()
        return run_study_of(flags, *ablation_variants(config))

    return study, listed("presets", PRESETS.described())
