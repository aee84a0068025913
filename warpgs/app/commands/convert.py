"""`warpgs convert`: write a file of Gaussians, or of cameras, in another format. Parses, calls, prints; no logic."""

from dataclasses import dataclass
from pathlib import Path

from warpgs.app.flags import either, parse_flags
from warpgs.runtime.terminal import say


def run(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` heads its help."""
    import tyro

    @dataclass(frozen=True)
    class Convert:
        source: tyro.conf.Positional[Path]
        """File to read: .ply, .compressed.ply, .splat, .spz, .sog, .glb or .gltf; or cameras: cameras.json, transforms.json,
        or a folder of COLMAP."""
        target: tyro.conf.Positional[Path]
        """File to write, of the same formats; cameras.json, transforms.json or sparse for cameras."""
        crop: str | None = None
        """Box to keep, in units of the scene's files: x,y,z,X,Y,Z, or a .json file such as the one that the viewer saves."""
        clean: tyro.conf.FlagCreatePairsOff[bool] = False
        """Remove what only disturbs: Gaussians larger than the scene, and long needles. Done unless the target is a .ply."""
        no_clean: tyro.conf.FlagCreatePairsOff[bool] = False
        """Keep these, too."""
        sh_degree: int | None = None
        """Highest degree of harmonics; 0 for colours that are the same from all sides. All where not given."""
        rotate: str | None = None
        """Turn the model about the origin: x,y,z,degrees."""

    a = parse_flags(Convert, arguments, "warpgs convert", about)
    from warpgs.pipeline.runs.export_filters import Filters
    from warpgs.pipeline.runs.export_model import convert

    for line in convert(a.source, a.target, Filters(a.crop, either(a, "clean"), a.sh_degree, a.rotate)):
        say(line)
    return 0
