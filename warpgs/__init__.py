"""Sparse-view Gaussian splatting on any machine: `warpgs fit scene/`, or `warpgs.rasterize` for the rasterizer alone."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

# Between its loops torch's OpenMP keeps its threads spinning, on cores that our own launches need: two threads then blend no
# faster than one. OpenMP reads this once, when torch is imported; whoever set it, or imported torch before us, has their way.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

__version__ = "0.1.0"

__all__ = [
    "Camera",
    "Gaussians",
    "RasterizeOptions",
    "Render",
    "Scene",
    "clear_graph_cache",
    "load_scene",
    "rasterize",
    "select_rule",
]  # fmt: skip

if TYPE_CHECKING:
    from warpgs.io.load import load_scene
    from warpgs.render.graphed import clear_graph_cache
    from warpgs.render.rasterize import RasterizeOptions, rasterize
    from warpgs.render.rule_costs import select_rule
    from warpgs.scene import Camera, Gaussians, Render, Scene

_HOMES = {
    "Camera": "warpgs.scene",
    "Gaussians": "warpgs.scene",
    "Render": "warpgs.scene",
    "Scene": "warpgs.scene",
    "RasterizeOptions": "warpgs.render.rasterize",
    "rasterize": "warpgs.render.rasterize",
    "select_rule": "warpgs.render.rule_costs",
    "clear_graph_cache": "warpgs.render.graphed",
    "load_scene": "warpgs.io.load",
}


def __getattr__(name: str) -> object:
    # Public names load on first use: torch and Warp cost seconds that `warpgs --help` must not pay.
    if name in _HOMES:
        import importlib

        return getattr(importlib.import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'warpgs' has no attribute {name!r}")
