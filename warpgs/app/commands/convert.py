"""`warpgs convert`: write a file of Gaussians, or of cameras, in another format. Parses, calls, prints; no logic."""

from dataclasses import dataclass
from pathlib import Path

from warpgs.app.flags import parse_flags
from warpgs.report.progress import waiting
from warpgs.runtime.terminal import say


def run(arguments: list[str], about: str) -> int:
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
    from warpgs.pipeline.runs.export_model import convert

    waiting()(f"writing {a.target.name}")
    for line in convert(a.source, a.target, filters_of(a), chosen_formats(a, a.target)):
        say(line)
    return 0
