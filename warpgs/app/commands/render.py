"""`warpgs render`: render a run. Parses, calls, prints; no logic."""

from dataclasses import dataclass
from pathlib import Path

from warpgs.app.flags import check_range, parse_flags
from warpgs.runtime.terminal import say


def run(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` heads its help."""
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

    a = parse_flags(Render, arguments, "warpgs render", about)
    check_range("--frames", a.frames, 1, 1_000_000)
    check_range("--fps", a.fps, 1, 1000)
    from warpgs.pipeline.runs.commands import render

    for line in render(a.run, a.path, a.out, a.frames, a.fps, a.device, a.coverage, background=a.background):
        say(line)
    return 0
