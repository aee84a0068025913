"""Sparse-view Gaussian splatting on any machine: `warpgs fit scene/`, or only the rasterizer, `warpgs.rasterize`.

Units: Gaussians and cameras are in ``scene`` units or in ``file`` units. A `Scene` that `load_scene` returns is in scene units:
recentred and rescaled. The scene's own files and PLY files are in file units. Functions that convert between the two have an
argument ``units``. All other functions, such as `rasterize`, need Gaussians and cameras in the same units.
"""

import sys
from typing import TYPE_CHECKING

from warpgs.faces import OldNames, lazy
from warpgs.openmp import let_idle_threads_sleep
from warpgs.version import __version__ as __version__

let_idle_threads_sleep()  # before torch is imported
sys.meta_path.insert(0, OldNames())

__all__ = [
    "PRESETS",
    "ActivatedGaussians",
    "Camera",
    "CovarianceGaussians",
    "DataError",
    "FitConfig",
    "FitResult",
    "Format",
    "Gaussians",
    "GivenDepth",
    "LossTerm",
    "MeshOptions",
    "Model",
    "Normalization",
    "NotFiniteError",
    "PointCloud",
    "RasterizeOptions",
    "Reader",
    "Render",
    "ResourceError",
    "Rule",
    "Scene",
    "StepReport",
    "StoredRun",
    "Strategy",
    "UsageError",
    "View",
    "ViewMetrics",
    "ViewModule",
    "WarpgsError",
    "clear_graph_cache",
    "depth_normals",
    "evaluate",
    "fit",
    "fuse_mesh",
    "gaussian_normals",
    "load",
    "load_scene",
    "look_at",
    "open_run",
    "rasterize",
    "read_ply",
    "render_path",
    "rule_named",
    "save",
    "select_rule",
    "write_demo",
    "write_ply",
]

if TYPE_CHECKING:
    from warpgs import export as export, io as io, kernels as kernels, train as train
    from warpgs.constants import Rule, rule_named
    from warpgs.errors import DataError, NotFiniteError, ResourceError, UsageError, WarpgsError
    from warpgs.export.base import Format
    from warpgs.export.ply import read_ply, write_ply
    from warpgs.geometry import depth_normals, gaussian_normals, look_at
    from warpgs.io.folder import Reader
    from warpgs.io.load import load_scene
    from warpgs.mesh.fuse import MeshOptions, fuse as fuse_mesh
    from warpgs.pipeline.films.film import render_path
    from warpgs.pipeline.metrics.scores import ViewMetrics, evaluate
    from warpgs.pipeline.model.table import Model, load, save
    from warpgs.pipeline.run.fit import FitResult, fit
    from warpgs.pipeline.run.folder import StoredRun, open_run
    from warpgs.pipeline.train.loss import LossTerm
    from warpgs.pipeline.train.presets import PRESETS
    from warpgs.pipeline.train.schedule import StepReport
    from warpgs.pipeline.train.settings import FitConfig
    from warpgs.pipeline.train.strategies.base import Strategy
    from warpgs.pipeline.train.view_modules import ViewModule
    from warpgs.render.graphed import clear_graph_cache
    from warpgs.render.options import RasterizeOptions
    from warpgs.render.rasterize import rasterize, select_rule
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
    from warpgs.synthetic.demo import write_demo
else:
    __getattr__, __dir__ = lazy(__name__)
