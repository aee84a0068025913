"""`warpgs plot`: plot a run's cameras and Gaussians. Parses, calls, prints; no logic."""

from dataclasses import dataclass
from pathlib import Path

from warpgs.app.flags import parse_flags
from warpgs.runtime.terminal import say


def run(arguments: list[str], about: str) -> int:
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
    from warpgs.pipeline.runs.plot import PlotSettings, plot

    for line in plot(a.run, a.out, PlotSettings(a.points, a.color, a.background, a.size, a.cameras), a.device):
        say(line)
    return 0
