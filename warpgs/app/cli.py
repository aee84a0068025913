"""The command line: parses, calls, prints; no logic."""

import contextlib
import gc
import os
import sys
from dataclasses import dataclass, field
from pathlib import Path

from warpgs import __version__
from warpgs.app.failures import report_defect, report_no_memory
from warpgs.app.flags import MAX_THREADS, check_range, parse_flags
from warpgs.errors import UsageError, WarpgsError
from warpgs.runtime.device_memory import is_out_of_memory
from warpgs.runtime.stop_signals import ignored_signals, interrupting_signals
from warpgs.runtime.terminal import accept_all_letters, say

COMMANDS = {
    "fit": "fit Gaussians to a scene folder and fill a run folder",
    "eval": "score a run again on its held-out views",
    "render": "render a run: its views, an orbit or a spiral, as PNG and mp4",
    "export": "write a run's Gaussians to a PLY file",
    "prune": "shrink a finished model as far as its training views allow, into a new run folder",
    "priors": "look at what is known before a fit (priors show), or write networks as ONNX (priors export)",
    "compare": "fit presets to scenes with several seeds; tables, plot and figure of the differences",
    "ablate": "fit a preset with its parts off one at a time; the same tables, plot and figure",
    "convert-lpips": "join published LPIPS weights into the file that --lpips-weights takes",
    "demo": "write a synthetic scene to try things with",
    "doctor": "say what this machine has, what is missing, and how to get it",
}


def _help() -> str:
    width = max(map(len, COMMANDS))
    rows = "\n".join(f"  {name:<{width}}  {text}" for name, text in COMMANDS.items())
    return (
        f"warpgs {__version__}: from a handful of posed photographs to a 3D Gaussian scene\n\n"
        f"usage: warpgs COMMAND [flags]\n\n{rows}\n\n"
        "`warpgs COMMAND --help` lists a command's flags. First steps: warpgs demo scene && warpgs fit scene --out run\n"
    )


@contextlib.contextmanager
def _importing():
    """Import without looking for garbage meanwhile or later: modules leave none, and looking takes a fifth of the time."""
    if "torch" in sys.modules or not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


def _parse(kind: type, name: str, arguments: list[str]):
    return parse_flags(kind, arguments, f"warpgs {name}", COMMANDS[name.split(maxsplit=1)[0]])


def _fit(arguments: list[str]) -> int:
    with _importing():
        from warpgs.app.cli_fit import fit

        request = fit(arguments, COMMANDS["fit"])
        from warpgs.pipeline.runs.fit import fit_request
    fit_request(request)
    return 0


def _eval(arguments: list[str]) -> int:
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
        """Reader from outside warpgs, as `warpgs fit --reader` was given it."""
        by_coverage: bool = False
        """Split the scores by how many training views saw what a pixel shows: none, one, two or more."""

    a = _parse(Eval, "eval", arguments)
    from warpgs.pipeline.runs.commands import evaluate

    for line in evaluate(a.run, a.device, a.lpips_weights, a.reader, a.by_coverage):
        say(line)
    return 0


def _render(arguments: list[str]) -> int:
    import tyro

    @dataclass(frozen=True)
    class Render:
        run: tyro.conf.Positional[Path]
        """Run folder of `warpgs fit`."""
        path: str = "views"
        """views (every view of the scene), orbit or spiral."""
        out: Path | None = None
        """Folder for the images and the film; RUN/path-PATH where not given."""
        frames: int = 90
        """Number of frames of an orbit or a spiral."""
        fps: int = 30
        """Frames per second of the film."""
        background: str = "auto"
        """auto (that of the fit; images of objects cut out are transparent PNGs), black, white, #rrggbb, or r,g,b in [0, 1]."""
        device: str = "auto"
        """auto, cpu or cuda."""
        coverage: bool = False
        """Write images of what no training view saw, too, into the subfolder coverage."""

    a = _parse(Render, "render", arguments)
    check_range("--frames", a.frames, 1, 1_000_000)
    check_range("--fps", a.fps, 1, 1000)
    from warpgs.pipeline.runs.commands import render

    for line in render(a.run, a.path, a.out, a.frames, a.fps, a.device, a.coverage, background=a.background):
        say(line)
    return 0


def _export(arguments: list[str]) -> int:
    import tyro

    @dataclass(frozen=True)
    class Export:
        run: tyro.conf.Positional[Path]
        """Run folder of `warpgs fit`."""
        to: Path
        """File to write; its suffix says the format: .ply."""

    a = _parse(Export, "export", arguments)
    from warpgs.pipeline.runs.commands import export

    for line in export(a.run, a.to):
        say(line)
    return 0


def _prune(arguments: list[str]) -> int:
    import tyro

    @dataclass(frozen=True)
    class Prune:
        run: tyro.conf.Positional[Path]
        """Run folder of `warpgs fit`; it stays as it is."""
        keep_psnr: float = 0.1
        """PSNR that the mean over the training views may fall by [dB]."""
        out: Path | None = None
        """Run folder to write; RUN-pruned where not given; must not exist yet."""
        device: str = "auto"
        """auto, cpu or cuda."""
        reader: str | None = None
        """Reader from outside warpgs, as `warpgs fit --reader` was given it."""

    a = _parse(Prune, "prune", arguments)
    from warpgs.pipeline.runs.prune import prune

    for line in prune(a.run, a.keep_psnr, a.out, a.device, a.reader):
        say(line)
    return 0


def _priors(arguments: list[str]) -> int:
    kinds = {"show": _priors_show, "export": _priors_export}
    if not arguments or arguments[0] not in kinds:
        if arguments and arguments[0] in ("-h", "--help"):
            say("usage: warpgs priors show SCENE --out DIR [flags]")
            say("       warpgs priors export --model MODEL --out FILE.onnx [flags]")
            return 0
        raise UsageError("priors: say show or export; `warpgs priors show --help` lists flags")
    return kinds[arguments[0]](arguments[1:])


def _priors_show(arguments: list[str]) -> int:
    import tyro

    from warpgs.io.decoding import MAX_PIXELS
    from warpgs.priors.view_prior import PriorConfig

    @dataclass(frozen=True)
    class Show:
        scene: tyro.conf.Positional[Path]
        """Scene folder."""
        out: Path
        """Folder for a PNG sheet per training view."""
        split: str | None = None
        """As for `warpgs fit`."""
        downscale: int = 1
        """Factor by which both image sides shrink."""
        allow_outside: bool = False
        """Let names and links of the scene lead to images and masks outside its folder."""
        max_pixels: int = MAX_PIXELS
        """Largest number of pixels that an image or a mask may have as stored."""
        threads: int = 0
        """CPU threads of the networks; 0 for as many as there are cores."""
        source: str = "sweep"
        """How depth is found in the other views where no depth network is named: sweep or flow, as --init.source of a fit."""
        priors: tyro.conf.OmitArgPrefixes[PriorConfig] = field(default_factory=PriorConfig)

    a = _parse(Show, "priors show", arguments)
    from warpgs.pipeline.runs.preview import show_priors
    from warpgs.pipeline.runs.request import SceneRequest

    check_range("--threads", a.threads, 0, MAX_THREADS)
    scene = SceneRequest(str(a.scene), a.split, a.downscale, allow_outside=a.allow_outside, max_pixels=a.max_pixels)
    for line in show_priors(scene, a.priors, a.source, a.out, a.threads):
        say(line)
    return 0


def _priors_export(arguments: list[str]) -> int:
    import tyro

    from warpgs.priors.export import ExportRequest

    @dataclass(frozen=True)
    class Export:
        request: tyro.conf.OmitArgPrefixes[ExportRequest]
        out: Path
        """ONNX file to write; FILE.onnx.json beside it says how to feed it."""

    a = _parse(Export, "priors export", arguments)
    from warpgs.priors.export import export_network

    for line in export_network(a.request, a.out):
        say(line)
    return 0


def _demo(arguments: list[str]) -> int:
    import tyro

    @dataclass(frozen=True)
    class Demo:
        folder: tyro.conf.Positional[Path]
        """Folder to write; must not exist yet."""
        views: int = 24
        """Number of photographs."""
        width: int = 320
        """Image width [px]."""
        height: int = 240
        """Image height [px]."""
        seed: int = 0
        """Decides the textures; of an object also its shape."""
        object: bool = False
        """Instead of a still life, an object with nothing around it: RGBA images, eight of them to fit."""
        format: str = "transforms"
        """Of an object: transforms (transforms.json with RGBA images) or colmap (RGB images with cut-out masks)."""

    a = _parse(Demo, "demo", arguments)
    check_range("--views", a.views, 8, 10_000)
    check_range("--width", a.width, 8, 8192)
    check_range("--height", a.height, 8, 8192)
    check_range("--seed", a.seed, 0, 2**31 - 1)
    size = {"views": a.views, "width": a.width, "height": a.height, "seed": a.seed}
    if a.object:
        from warpgs.synthetic.cut_out import write_object

        split, masks = write_object(a.folder, form=a.format, **size), " --masks cutout" if a.format == "colmap" else ""
    else:
        from warpgs.synthetic.demo import write_demo

        split, masks = write_demo(a.folder, **size), ""
    form = "transforms.json" if a.object and a.format == "transforms" else "COLMAP"
    say(f"{a.folder}: {a.views} views of {a.width} x {a.height} px as a {form} folder")
    say(f"next: warpgs fit {a.folder} --split '{split}'{masks} --out run")
    return 0


def _doctor(arguments: list[str]) -> int:
    @dataclass(frozen=True)
    class Doctor:
        warm: bool = False
        """Instead, compile all kernels that a fit uses on this machine's devices, so that none waits for it."""
        repeat: Path | None = None
        """Instead, compute a step again whose loss was not finite, and say what is not: not_finite.safetensors of a run."""
        device: str = "auto"
        """Device for --repeat: auto, cpu or cuda."""

    a = _parse(Doctor, "doctor", arguments)
    if a.repeat is not None:
        from warpgs.pipeline.runs.commands import repeat_failed_step

        for line in repeat_failed_step(a.repeat, a.device):
            say(line)
        return 0
    if a.warm:
        with _importing():
            from warpgs.app.precompile import print_warming
        print_warming()
        return 0
    from warpgs.app.doctor import diagnose, print_report

    return print_report(diagnose())


def _study(name: str):
    """The command of a name that `cli_studies` holds."""

    def command(arguments: list[str]) -> int:
        from warpgs.app import cli_study

        return getattr(cli_study, name.replace("-", "_"))(arguments, COMMANDS[name])

    return command


RUN = {
    "fit": _fit, "eval": _eval, "render": _render, "export": _export, "prune": _prune, "priors": _priors,
    "demo": _demo, "doctor": _doctor,
    **{name: _study(name) for name in ("compare", "ablate", "convert-lpips")},
}  # fmt: skip


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns its exit code: 0 done, 2 usage, 3 data, 4 resources, 5 internal, 130 interrupted."""
    accept_all_letters()
    with interrupting_signals():
        return _run(sys.argv[1:] if arguments is None else arguments)


def _run(arguments: list[str]) -> int:
    """Run one command; an error becomes one line and an exit code."""
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        for line in _help().splitlines():
            say(line)
        return 0 if arguments else 2
    if arguments[0] in ("--version", "-V"):
        say(f"warpgs {__version__}")
        return 0
    name = arguments[0]
    try:
        if name not in RUN:
            raise UsageError(f"there is no command {name!r}; choose one of {', '.join(RUN)}")
        return RUN[name](arguments[1:])
    except WarpgsError as e:
        say(f"warpgs: {e}", error=True)
        return e.exit_code
    except KeyboardInterrupt:
        with ignored_signals():
            say("warpgs: interrupted; --resume continues from the last checkpoint", error=True)
        return 130
    except BrokenPipeError:  # the reader, `head` for one, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as e:
        return report_no_memory(e) if is_out_of_memory(e) else report_defect(e, arguments)


if __name__ == "__main__":
    sys.exit(main())
