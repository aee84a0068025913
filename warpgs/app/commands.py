"""Commands: each parses its flags, calls and prints; no logic."""

import functools
import shlex
from dataclasses import dataclass, field, make_dataclass
from pathlib import Path
from typing import Annotated

from warpgs.app.flags import MAX_THREADS, check_range, listed, load_own, parse_flags, word_after
from warpgs.errors import UsageError
from warpgs.io.image_files import MAX_PIXELS
from warpgs.process import say
from warpgs.report.progress import waiting

# `warpgs demo`: write a synthetic scene. Parses, calls, prints; no logic.


def run_demo(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` describes it in its help.

    Raises:
        UsageError: Flags exclude each other, or a value is invalid.
    """
    import tyro

    @dataclass(frozen=True)
    class Demo:
        folder: tyro.conf.Positional[Path]
        """Folder to write; new or empty."""
        views: int = 24
        """Number of photographs."""
        width: int = 320
        """Image width [px]."""
        height: int = 240
        """Image height [px]."""
        seed: int = 0
        """Seed of the textures, and of the shape of an object."""
        object: bool = False
        """Write a single object instead of a still life; eight of the views are for training."""
        format: str = "transforms"
        """Format of --object: transforms (transforms.json with RGBA images) or colmap (RGB images with cut-out masks)."""

    a = parse_flags(Demo, arguments, "warpgs demo", about)
    check_range("--views", a.views, 8, 10_000)
    check_range("--width", a.width, 32, 8192)
    check_range("--height", a.height, 32, 8192)
    check_range("--seed", a.seed, 0, 2**31 - 1)
    if a.format not in ("transforms", "colmap"):
        raise UsageError(f"--format must be transforms or colmap, not {a.format!r}")
    if a.format != "colmap" and not a.object and word_after(arguments, "--format") is not None:
        raise UsageError("--format requires --object: the still life is always written as COLMAP")
    size = {"views": a.views, "width": a.width, "height": a.height, "seed": a.seed}
    if a.object:
        from warpgs.synthetic.demo import write_object

        write_object(a.folder, form=a.format, **size, tell=waiting())
        flags = "--split llff:8" + (" --masks cutout" if a.format == "colmap" else "")
    else:
        from warpgs.synthetic.demo import write_demo

        write_demo(a.folder, **size, tell=waiting())
        flags = "--split every:8"
    form = "transforms.json" if a.object and a.format == "transforms" else "COLMAP"
    say(f"{a.folder}: {a.views} views of {a.width} x {a.height} px as a {form} folder")
    say(f"next: warpgs fit {shlex.quote(str(a.folder))} {flags} --out run")
    return 0


# `warpgs poses`: find the poses of photographs or of a video. Parses, calls, prints; no logic.


def run_poses(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` describes it in its help."""
    import tyro

    from warpgs.poses.find import FRAMES, find_poses

    @dataclass(frozen=True)
    class Poses:
        photographs: tyro.conf.Positional[Path]
        """Folder of photographs, or a video file."""
        out: Path
        """Scene folder to write; new or empty."""
        frames: int = FRAMES
        """Frames to take from a video, evenly spaced and sharp."""
        threads: int = 0
        """CPU threads; 0 for as many as there are cores."""
        max_pixels: int = MAX_PIXELS
        """Largest number of pixels that an image may have."""
        allow_outside: bool = False
        """Allow links to photographs outside the folder."""

        matcher: Path | None = None
        """ONNX file of `warpgs priors export --model xfeat`; finds matches where SIFT leaves photographs without a pose."""

    a = parse_flags(Poses, arguments, "warpgs poses", about)
    check_range("--frames", a.frames, 3, 1000)
    check_range("--threads", a.threads, 0, MAX_THREADS)
    check_range("--max-pixels", a.max_pixels, 1, 2**40)
    from warpgs.poses.find import TEXT, report_lines
    from warpgs.report.progress import Stages

    record = find_poses(
        a.photographs, a.out, frames=a.frames, threads=a.threads, max_pixels=a.max_pixels, allow_outside=a.allow_outside,
        matcher=a.matcher, progress=Stages(),
    )  # fmt: skip
    for line in report_lines(record):
        say(line)
    say(f"{a.out}: a COLMAP scene; the lines above are also in {a.out / TEXT}")
    say(f"next: warpgs fit {shlex.quote(str(a.out))} --out run")
    return 0


# `warpgs view`: look at a model in a browser. Parses, calls, prints; no logic.


def run_view(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` describes it in its help."""
    import tyro

    @dataclass(frozen=True)
    class View:
        run: tyro.conf.Positional[Path]
        """Run folder of `warpgs fit`, also during the fit; or a file of Gaussians, in a format of `warpgs convert`."""
        port: int = 8080
        """Port of the viewer on this machine; 0 for any free one."""
        device: str = "auto"
        """Device that renders depth, coverage and error: auto, cpu or cuda."""
        reader: str | None = None
        """User-defined reader, as for `warpgs fit --reader`."""

    a = parse_flags(View, arguments, "warpgs view", about)
    check_range("--port", a.port, 0, 65535)
    from warpgs.viewer.watch import view

    view(a.run, a.port, a.device, a.reader)
    return 0


# `warpgs render`: render a run. Parses, calls, prints; no logic.


def run_render(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` describes it in its help.

    Raises:
        UsageError: Cameras, a rule or antialiasing are given for a run.
    """
    import tyro

    @dataclass(frozen=True)
    class Render:
        run: tyro.conf.Positional[Path]
        """Run folder of `warpgs fit`, or a file of Gaussians from any program, in a format of `warpgs convert`."""
        cameras: Path | None = None
        """Cameras for a file of Gaussians: cameras.json, transforms.json, a COLMAP folder, or a scene."""
        rule: str | None = None
        """Cut-offs with which a file of Gaussians was trained: inria (default), gsplat-1.6, gsplat-1.5 or exact."""
        antialiased: bool = False
        """Render a file of Gaussians with antialiasing. Needed for antialiased models (gsplat's rasterize_mode antialiased) if
        the file does not declare this."""
        path: str = "auto"
        """auto (chosen from the cameras), turntable, spiral, interpolate (through the training views), views
        (every view of the scene), or a .json file of keyframes."""
        out: Path | None = None
        """Folder for the images and film.mp4; or a file for the film alone: .mp4, .webm, .webp or .gif. Existing files are
        replaced. Default: path-PATH in the run folder, or beside the file of Gaussians."""
        seconds: float | None = None
        """Duration of the film [s]. Default: chosen by the path."""
        fps: int = 30
        """Frames per second of the film."""
        frames: int | None = None
        """Number of frames. Default: seconds times fps."""
        size: tuple[int, int] | None = None
        """Width and height of the frames [px]. Default: those of the photographs."""
        fov: float | None = None
        """Vertical field of view [deg]. Default: that of the photographs."""
        background: str = "auto"
        """auto (the fit's colour; images of cut-out objects are transparent PNGs), black, white, #rrggbb or r,g,b in [0, 1]."""
        sheet: bool = False
        """Also write six frames in one image: sheet.png."""
        device: str = "auto"
        """auto, cpu or cuda."""
        coverage: bool = False
        """Also write images of the coverage by training views, into the subfolder coverage."""

    a = parse_flags(Render, arguments, "warpgs render", about)
    check_range("--fps", a.fps, 1, 1000)
    from math import radians

    from warpgs.pipeline.films.film import FilmSettings
    from warpgs.pipeline.run.commands import render

    settings = FilmSettings(a.frames, a.seconds, a.fps, a.size, None if a.fov is None else radians(a.fov))
    if a.run.is_dir() and (a.cameras is not None or a.rule is not None or a.antialiased):
        raise UsageError("--cameras, --rule and --antialiased are for files of Gaussians; leave them out for a run")
    given = (a.cameras, a.rule) if a.run.is_file() or a.cameras is not None else None
    for line in render(
        a.run, a.path, a.out, settings, a.device,
        background=a.background, coverage=a.coverage, sheet=a.sheet, file_of=given, antialiased=a.antialiased,
    ):  # fmt: skip
        say(line)
    return 0


# `warpgs plot`: plot a run's cameras and Gaussians. Parses, calls, prints; no logic.


def run_plot(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` describes it in its help."""
    import tyro

    @dataclass(frozen=True)
    class Plot:
        run: tyro.conf.Positional[Path]
        """Run folder of `warpgs fit`."""
        out: Path | None = None
        """PNG file to write. Default: plot.png in the run folder."""
        points: str = "gaussians"
        """gaussians, or start (the points of the scene's reconstruction)."""
        color: str = "own"
        """own (colour of the Gaussian or point), or coverage (how many training views see each Gaussian)."""
        background: str = "white"
        """white or black."""
        size: tuple[int, int] = (1600, 1000)
        """Width and height [px]."""
        cameras: bool = True
        """Show the cameras."""
        device: str = "auto"
        """auto, cpu or cuda."""

    a = parse_flags(Plot, arguments, "warpgs plot", about)
    from warpgs.pipeline.run.commands import PlotSettings, plot

    for line in plot(a.run, a.out, PlotSettings(a.points, a.color, a.background, a.size, a.cameras), a.device):
        say(line)
    return 0


# `warpgs priors`: show depth and saliency before a fit, or write networks as ONNX. Parses, calls, prints; no logic.

USAGE = (
    "usage: warpgs priors show SCENE --out DIR [flags]",
    "       warpgs priors export --model MODEL --out FILE.onnx [flags]",
    "",
    "`warpgs priors show --help` and `warpgs priors export --help` list their flags.",
)


def run_priors(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` describes it in its help.

    Raises:
        UsageError: The first argument is neither show nor export.
    """
    kinds = {"show": _show, "export": _export}
    if not arguments or arguments[0] not in kinds:
        if arguments and arguments[0] in ("-h", "--help", "--help-all"):
            for line in (f"warpgs priors: {about}", "", *USAGE):
                say(line)
            return 0
        raise UsageError("priors: give show or export; `warpgs priors --help` shows how")
    return kinds[arguments[0]](arguments[1:])


def _show(arguments: list[str]) -> int:
    import tyro

    from warpgs.io.image_files import MAX_PIXELS
    from warpgs.priors.views import PriorConfig

    @dataclass(frozen=True)
    class Show:
        scene: tyro.conf.Positional[Path]
        """Scene folder."""
        out: Path
        """Folder for PNG sheets, one for each training view."""
        split: str | None = None
        """Split, as for `warpgs fit`."""
        downscale: int | None = None
        """Factor by which both image sides shrink; if given, --max-side has no default limit."""
        max_side: int | None = None
        """Largest image side [px], 0 for no limit. Default: 1600 without --downscale."""
        allow_outside: bool = False
        """Allow names and links that point to files outside the scene folder."""
        max_pixels: int = MAX_PIXELS
        """Largest number of pixels that an image or a mask may have as stored."""
        threads: int = 0
        """CPU threads of the networks; 0 for as many as there are cores."""
        source: str = "sweep"
        """Method of depth estimation without a network: sweep or flow, as for --init.source of a fit."""
        priors: tyro.conf.OmitArgPrefixes[PriorConfig] = field(default_factory=PriorConfig)

    a = parse_flags(Show, arguments, "warpgs priors show", "write depth and saliency of each training view as images")
    from warpgs.pipeline.run.commands import show_priors
    from warpgs.pipeline.run.request import SceneRequest

    check_range("--threads", a.threads, 0, MAX_THREADS)
    scene = SceneRequest(
        str(a.scene),
        a.split,
        downscale=a.downscale,
        allow_outside=a.allow_outside,
        max_pixels=a.max_pixels,
        max_side=a.max_side,
    )
    for line in show_priors(scene, a.priors, a.source, a.out, a.threads):
        say(line)
    return 0


def _export(arguments: list[str]) -> int:
    import tyro

    from warpgs.priors.export import ExportRequest

    @dataclass(frozen=True)
    class Export:
        request: tyro.conf.OmitArgPrefixes[ExportRequest]
        out: Path
        """ONNX file to write; FILE.onnx.json beside it describes its input."""

    a = parse_flags(Export, arguments, "warpgs priors export", "write a network as an ONNX file")
    from warpgs.priors.export import export_network

    for line in export_network(a.request, a.out):
        say(line)
    return 0


# `warpgs export`: write a run's Gaussians, or its cameras, to a file. Parses, calls, prints; no logic.


def run_export(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` describes it in its help."""
    import tyro

    from warpgs.app.format_flags import chosen_formats, filters_of, format_flags, format_lines

    base = format_flags(arguments)

    @dataclass(frozen=True, kw_only=True)
    class Export(base):
        run: tyro.conf.Positional[Path]
        """Run folder of `warpgs fit`."""
        to: Path
        """File to write; its suffix chooses the format. For cameras: cameras.json, transforms.json, or sparse (COLMAP)."""

    page = "  .html: a page that shows the model in any browser"
    a = parse_flags(Export, arguments, "warpgs export", f"{about}\n\n{format_lines()}\n{page}")
    formats, filters = chosen_formats(a, a.to), filters_of(a)
    waiting()(f"writing {a.to.name}")
    if a.to.suffix.lower() == ".html" and not formats:
        from warpgs.viewer.html import export_html

        lines = export_html(a.run, a.to, filters)
    else:
        from warpgs.pipeline.run.export import export

        lines = export(a.run, a.to, filters, formats[0] if formats else None)
    for line in lines:
        say(line)
    return 0


# `warpgs convert`: write a file of Gaussians, or of cameras, in another format. Parses, calls, prints; no logic.


def run_convert(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` describes it in its help."""
    import tyro

    from warpgs.app.format_flags import chosen_formats, filters_of, format_flags, format_lines

    base = format_flags(arguments)

    @dataclass(frozen=True, kw_only=True)
    class Convert(base):
        source: tyro.conf.Positional[Path]
        """File of Gaussians to read; or cameras: cameras.json, transforms.json, or a COLMAP folder."""
        target: tyro.conf.Positional[Path]
        """File to write. For cameras: cameras.json, transforms.json, or sparse (COLMAP)."""

    a = parse_flags(Convert, arguments, "warpgs convert", f"{about}\n\n{format_lines()}")
    from warpgs.pipeline.run.export import convert

    waiting()(f"writing {a.target.name}")
    for line in convert(a.source, a.target, filters_of(a), chosen_formats(a, a.target)):
        say(line)
    return 0


# `warpgs mesh`: make a mesh of a run. Parses, calls, prints; no logic.


def run_mesh(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` describes it in its help."""
    import tyro

    @dataclass(frozen=True)
    class Mesh:
        run: tyro.conf.Positional[Path]
        """Run folder of `warpgs fit`."""
        out: Path
        """File to write: .ply, or .glb (glTF)."""
        voxel: float | None = None
        """Side of a voxel, in units of the scene's files; smaller voxels show more detail and more noise."""
        resolution: int | None = None
        """Voxels along the longest side of the mesh, instead of --voxel. Default: 256, or fewer for small images."""
        max_faces: int = 200_000
        """Largest number of triangles; larger meshes are simplified."""
        depth: str = "median"
        """Rendered depth to fuse: median, or mean, which is less accurate at edges."""
        device: str = "auto"
        """auto, cpu or cuda."""

    a = parse_flags(Mesh, arguments, "warpgs mesh", about)
    from warpgs.mesh.fuse import MeshOptions
    from warpgs.pipeline.run.export import mesh
    from warpgs.report.progress import Stages

    options = MeshOptions(a.voxel, a.resolution, a.max_faces, a.depth)
    for line in mesh(a.run, a.out, options, a.device, stage=Stages(), say=say):
        say(line)
    return 0


# `warpgs prune`: shrink a finished model. Parses, calls, prints; no logic.


def run_prune(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` describes it in its help."""
    import tyro

    @dataclass(frozen=True)
    class Prune:
        run: tyro.conf.Positional[Path]
        """Run folder of `warpgs fit`; it is not changed."""
        keep_psnr: float = 0.1
        """Largest drop of the mean PSNR over the training views [dB]."""
        out: Path | None = None
        """Run folder to write; must not exist yet. Default: RUN-pruned."""
        device: str = "auto"
        """auto, cpu or cuda."""
        reader: str | None = None
        """User-defined reader, as for `warpgs fit --reader`."""

    a = parse_flags(Prune, arguments, "warpgs prune", about)
    from warpgs.pipeline.run.commands import prune
    from warpgs.report.progress import Stages

    for line in prune(a.run, a.keep_psnr, a.out, a.device, a.reader, Stages()):
        say(line)
    return 0


# `warpgs eval`: score a run again. Parses, calls, prints; no logic.


def run_eval(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` describes it in its help."""
    import tyro

    @dataclass(frozen=True)
    class Eval:
        run: tyro.conf.Positional[Path]
        """Run folder of `warpgs fit`."""
        device: str = "auto"
        """auto, cpu or cuda."""
        lpips_weights: Path | None = None
        """File of `warpgs convert-lpips`; without it LPIPS is not measured."""
        reader: str | None = None
        """User-defined reader, as for `warpgs fit --reader`."""
        by_coverage: bool = False
        """Split the scores by the number of training views that saw each pixel's surface: none, one, two or more."""

    a = parse_flags(Eval, arguments, "warpgs eval", about)
    from warpgs.pipeline.run.commands import evaluate

    for line in evaluate(a.run, a.device, a.lpips_weights, a.reader, a.by_coverage):
        say(line)
    return 0


# `warpgs convert-lpips`: join published LPIPS weights. Parses, calls, prints; no logic.


def run_convert_lpips(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` describes it in its help."""

    @dataclass(frozen=True)
    class ConvertLpips:
        backbone: Path
        """torchvision's state dict of vgg16 or alexnet (.pth)."""
        heads: Path
        """vgg.pth or alex.pth of PerceptualSimilarity, folder lpips/weights/v0.1."""
        out: Path
        """File to write (.safetensors)."""

    a = parse_flags(ConvertLpips, arguments, "warpgs convert-lpips", about)
    from warpgs.pipeline.metrics.lpips import convert_lpips as convert

    for line in convert(a.backbone, a.heads, a.out):
        say(line)
    return 0


# `warpgs compare` and `warpgs ablate`: their common part. Parses, calls, prints; no logic.


def study_flags() -> type:
    """Return the dataclass of the flags that `compare` and `ablate` share."""
    import tyro

    from warpgs.app.fit import scene_flags

    reading, unread = scene_flags(positional=False)

    @dataclass(frozen=True, kw_only=True)
    class Study:
        scenes: tyro.conf.Positional[tuple[Path, ...]]
        """Scene folders."""
        out: Path
        """Folder of the study; repeat the command to continue an interrupted study."""
        seeds: int = 5
        """Number of runs of each setting on each scene; seeds count from 0."""
        steps: int | None = None
        """Optimisation steps of every run. Default: as in `warpgs fit`."""
        device: str = "auto"
        """auto, cpu or cuda."""
        slots: int | None = None
        """Number of concurrent runs, each in its own process. If neither --slots nor --per-gpu is given, runs follow each other
        in one process."""
        per_gpu: int | None = None
        """Runs that share a GPU."""
        lpips_weights: Path | None = None
        """File of `warpgs convert-lpips`; without it LPIPS is not measured."""

    hint = Annotated[reading, tyro.conf.arg(name="")]
    return make_dataclass("Study", [("reading", hint, field(default=unread))], bases=(Study,), frozen=True, kw_only=True)


def run_study_of(a, variants: dict, marks: dict) -> int:
    """Run the study of parsed flags."""
    from warpgs.app.fit import scene_of
    from warpgs.pipeline.farm.farm import EngineRequest
    from warpgs.pipeline.study.study import StudyRequest, run_study

    scenes = tuple(scene_of(a.reading, str(s)) for s in a.scenes)
    farm = (
        None
        if a.slots is None and a.per_gpu is None
        else EngineRequest(slots=a.slots, per_gpu=1 if a.per_gpu is None else a.per_gpu)
    )
    for line in run_study(StudyRequest(scenes, variants, a.seeds, a.out, a.device, a.lpips_weights, farm, marks)):
        say(line)
    return 0


# `warpgs compare`: presets against each other. Parses, calls, prints; no logic.


def run_compare(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` describes it in its help."""
    from warpgs.pipeline.train.presets import PRESETS

    base = study_flags()

    @dataclass(frozen=True, kw_only=True)
    class Compare(base):
        presets: str = ",".join(PRESETS)
        """Presets as for `warpgs fit --preset`, separated by commas; the others are compared with the first."""

    a = parse_flags(Compare, arguments, "warpgs compare", f"{about}\n\n{listed('presets', PRESETS.described())}")
    from warpgs.pipeline.study.study import preset_variants
    from warpgs.pipeline.train.presets import preset_settings

    names = [n.strip() for n in a.presets.split(",") if n.strip()]
    for name in names:  # so that an error names its preset
        load_own("preset", name, functools.partial(preset_settings, name))
    return run_study_of(a, preset_variants(names, a.steps), {})


# `warpgs ablate`: a preset with one part changed at a time. Parses, calls, prints; no logic.


def run_ablate(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` describes it in its help."""
    from warpgs.pipeline.train.presets import DEFAULT_PRESET, PRESETS

    base = study_flags()

    @dataclass(frozen=True, kw_only=True)
    class Ablate(base):
        preset: str = DEFAULT_PRESET
        """Preset, as for `warpgs fit --preset`; one part is changed at a time."""

    a = parse_flags(Ablate, arguments, "warpgs ablate", f"{about}\n\n{listed('presets', PRESETS.described())}")
    from warpgs.pipeline.study.study import ablation_variants, preset_variants

    (config,) = load_own("preset", a.preset, lambda: preset_variants([a.preset], a.steps)).values()
    return run_study_of(a, *ablation_variants(config))
