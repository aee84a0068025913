"""`warpgs eval`: score a run again. Parses, calls, prints; no logic."""

from dataclasses import dataclass
from pathlib import Path

from warpgs.app.flags import parse_flags
from warpgs.runtime.terminal import say


def run(arguments: list[str], about: str) -> int:
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
    from warpgs.pipeline.runs.commands import evaluate

    for line in evaluate(a.run, a.device, a.lpips_weights, a.reader, a.by_coverage):
        say(line)
    return 0
