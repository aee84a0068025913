"""`warpgs priors`: show depth and saliency before a fit, or write networks as ONNX. Parses, calls, prints; no logic."""

from dataclasses import dataclass, field
from pathlib import Path

from warpgs.app.flags import MAX_THREADS, check_range, parse_flags
from warpgs.errors import UsageError
from warpgs.runtime.terminal import say

USAGE = (
    "usage: warpgs priors show SCENE --out DIR [flags]",
    "       warpgs priors export --model MODEL --out FILE.onnx [flags]",
    "",
    "`warpgs priors show --help` and `warpgs priors export --help` list their flags.",
)


def run(arguments: list[str], about: str) -> int:
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

    from warpgs.io.decoding import MAX_PIXELS
    from warpgs.priors.view_prior import PriorConfig

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
    from warpgs.pipeline.runs.preview import show_priors
    from warpgs.pipeline.runs.request import SceneRequest

    check_range("--threads", a.threads, 0, MAX_THREADS)
    scene = SceneRequest(
        str(a.scene), a.split, a.downscale, allow_outside=a.allow_outside, max_pixels=a.max_pixels, max_side=a.max_side
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
