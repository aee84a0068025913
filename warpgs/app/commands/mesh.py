"""`warpgs mesh`: make a mesh of a run. Parses, calls, prints; no logic."""

from dataclasses import dataclass
from pathlib import Path

from warpgs.app.flags import parse_flags
from warpgs.runtime.terminal import say


def run(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` describes it in its help."""
    import tyro

    @dataclass(frozen=True)
    class Mesh:
        run: tyro.conf.Positional[Path]
        """Run folder of `warpgs fit`."""
        out: Path
        """File to write: .ply, or .glb (glTF)."""
        voxel: float | None = None
        """Side of a voxel, in units of the scene's files; smaller voxels show more detail and more noise."""
        resolution: int | None = None
        """Voxels along the longest side of the mesh, instead of --voxel. Default: 256, or fewer for small images."""
        max_faces: int = 200_000
        """Largest number of triangles; larger meshes are simplified."""
        depth: str = "median"
        """Rendered depth to fuse: median, or mean, which is less accurate at edges."""
        device: str = "auto"
        """auto, cpu or cuda."""

    a = parse_flags(Mesh, arguments, "warpgs mesh", about)
    from warpgs.mesh.fuse import MeshOptions
    from warpgs.pipeline.runs.mesh_of_run import mesh
    from warpgs.report.progress import Stages

    options = MeshOptions(a.voxel, a.resolution, a.max_faces, a.depth)
    for line in mesh(a.run, a.out, options, a.device, stage=Stages(), say=say):
        say(line)
    return 0
