"""`warpgs prune`: shrink a finished model. Parses, calls, prints; no logic."""

from dataclasses import dataclass
from pathlib import Path

from warpgs.app.flags import parse_flags
from warpgs.runtime.terminal import say


def run(arguments: list[str], about: str) -> int:
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
    from warpgs.pipeline.runs.prune import prune
    from warpgs.report.progress import Stages

    for line in prune(a.run, a.keep_psnr, a.out, a.device, a.reader, Stages()):
        say(line)
    return 0
