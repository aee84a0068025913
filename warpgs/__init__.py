"""Sparse-view Gaussian splatting on any machine: `warpgs fit scene/`, or only the rasterizer, `warpgs.rasterize`.

Units: Gaussians and cameras are in ``scene`` units or in ``file`` units. A `Scene` that `load_scene` returns is in scene units:
recentred and rescaled. The scene's own files and PLY files are in file units. Functions that convert between the two have an
argument ``units``. All other functions, such as `rasterize`, need Gaussians and cameras in the same units.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from warpgs.runtime.openmp import let_idle_threads_sleep
from warpgs.version import __version__ as __version__

let_idle_threads_sleep()  # before torch is imported

__all__ = [
    "PRESETS",
    "ActivatedGaussians",
    "Camera",
    "CovarianceGaussians",
    "FitConfig",
    "FitResult",
    "Format",
    "Gaussians",
    "GivenDepth",
    "LossTerm",
    "Model",
    "Normalization",
    "PointCloud",
    "RasterizeOptions",
    "Reader",
    "Render",
    "Rule",
    "Scene",
    "StepReport",
    "StoredRun",
    "Strategy",
    "View",
    "ViewMetrics",
    "ViewModule",
    "clear_graph_cache",
    "evaluate",
    "fit",
    "load",
    "load_scene",
    "open_run",
    "rasterize",
    "read_ply",
    "render_path",
    "save",
    "select_rule",
    "write_ply",
]

if TYPE_CHECKING:
    from warpgs.constants import Rule
    from warpgs.export.base import Format
    from warpgs.export.ply import read_ply, write_ply
    from warpgs.io.load import load_scene
    from warpgs.io.readers import Reader
    from warpgs.pipeline.films.film import render_path
    from warpgs.pipeline.metrics.evaluate import ViewMetrics, evaluate
    from warpgs.pipeline.model.model_file import Model, load, save
    from warpgs.pipeline.runs.fit import FitResult, fit
    from warpgs.pipeline.runs.folder import StoredRun, open_run
    from warpgs.pipeline.train.config import FitConfig
    from warpgs.pipeline.train.loss import LossTerm
    from warpgs.pipeline.train.presets import PRESETS
    from warpgs.pipeline.train.step_report import StepReport
    from warpgs.pipeline.train.strategies.base import Strategy
    from warpgs.pipeline.train.view_modules.base import ViewModule
    from warpgs.render.graphed import clear_graph_cache
    from warpgs.render.options import RasterizeOptions
    from warpgs.render.rasterize import rasterize
    from warpgs.render.select_rule import select_rule
    from warpgs.scene import (
        ActivatedGaussians,
        Camera,
        CovarianceGaussians,
        Gaussians,
        GivenDepth,
        Normalization,
        PointCloud,
        Render,
        Scene,
        View,
    )

_HOMES = {
    name: module
    for module, names in {
        "warpgs.export.base": ("Format",),
        "warpgs.export.ply": ("read_ply", "write_ply"),
        "warpgs.io.load": ("load_scene",),
        "warpgs.io.readers": ("Reader",),
        "warpgs.pipeline.metrics.evaluate": ("ViewMetrics", "evaluate"),
        "warpgs.pipeline.runs.fit": ("FitResult", "fit"),
        "warpgs.pipeline.runs.folder": ("StoredRun", "open_run"),
        "warpgs.pipeline.model.model_file": ("Model", "load", "save"),
        "warpgs.pipeline.films.film": ("render_path",),
        "warpgs.pipeline.train.config": ("FitConfig",),
        "warpgs.pipeline.train.loss": ("LossTerm",),
        "warpgs.pipeline.train.presets": ("PRESETS",),
        "warpgs.pipeline.train.strategies.base": ("Strategy",),
        "warpgs.pipeline.train.view_modules.base": ("ViewModule",),
        "warpgs.pipeline.train.step_report": ("StepReport",),
        "warpgs.render.graphed": ("clear_graph_cache",),
        "warpgs.render.options": ("RasterizeOptions",),
        "warpgs.render.rasterize": ("rasterize",),
        "warpgs.render.select_rule": ("select_rule",),
        "warpgs.constants": ("Rule",),
        "warpgs.scene": (
            "ActivatedGaussians",
            "Camera",
            "CovarianceGaussians",
            "Gaussians",
            "GivenDepth",
            "Normalization",
            "PointCloud",
            "Render",
            "Scene",
            "View",
        ),
    }.items()
    for name in names
}
"""Module of each public name. Modules load on first use, because importing torch and Warp would delay `warpgs --help` by
seconds."""


def __getattr__(name: str) -> object:
    """Import a public name on first use."""
    if name not in _HOMES:
        raise AttributeError(f"module 'warpgs' has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    """Return the public names and those with two underscores."""
    return sorted([*__all__, *(n for n in globals() if n.startswith("__"))])
