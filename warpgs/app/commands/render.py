"""`warpgs render`: render a run. Parses, calls, prints; no logic."""

from dataclasses import dataclass
from pathlib import Path

from warpgs.app.flags import check_range, parse_flags
from warpgs.errors import UsageError
from warpgs.runtime.terminal import say


def run(arguments: list[str], about: str) -> int:
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

    from warpgs.pipeline.films.plan import FilmSettings
    from warpgs.pipeline.runs.commands import render

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
