"""`warpgs convert`: a file of Gaussians in another format. Parses, calls, prints; no logic."""

from dataclasses import dataclass
from pathlib import Path

from warpgs.app.flags import parse_flags
from warpgs.runtime.terminal import say


def run(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` heads its help."""
    import tyro

    @dataclass(frozen=True)
    class Convert:
        source: tyro.conf.Positional[Path]
        """File to read: .ply, .compressed.ply, .splat, .spz, .sog, .glb or .gltf."""
        target: tyro.conf.Positional[Path]
        """File to write; its suffix says the format, one of the same."""

    a = parse_flags(Convert, arguments, "warpgs convert", about)
    from warpgs.pipeline.runs.commands import convert

    for line in convert(a.source, a.target):
        say(line)
    return 0
