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

if TYPE_CHECKING:
    from warpgs import export as export, io as io, kernels as kernels, train as train
    from warpgs.constants import Rule as Rule, rule_named as rule_named
    from warpgs.errors import (
        DataError as DataError,
        NotFiniteError as NotFiniteError,
        ResourceError as ResourceError,
        UsageError as UsageError,
        WarpgsError as WarpgsError,
    )
    from warpgs.export.base import Format as Format
    from warpgs.export.ply import read_ply as read_ply, write_ply as write_ply
    from warpgs.geometry import depth_normals as depth_normals, gaussian_normals as gaussian_normals, look_at as look_at
    from warpgs.io.folder import Reader as Reader
    from warpgs.io.load import load_scene as load_scene
    from warpgs.mesh.fuse import MeshOptions as MeshOptions, fuse_mesh as fuse_mesh
    from warpgs.pipeline.films.film import render_path as render_path
    from warpgs.pipeline.metrics.scores import ViewMetrics as ViewMetrics, evaluate as evaluate
    from warpgs.pipeline.model.table import Model as Model, load as load, save as save
    from warpgs.pipeline.run.fit import FitResult as FitResult, fit as fit
    from warpgs.pipeline.run.folder import StoredRun as StoredRun, open_run as open_run
    from warpgs.pipeline.train.loss import LossTerm as LossTerm
    from warpgs.pipeline.train.presets import PRESETS as PRESETS
    from warpgs.pipeline.train.schedule import StepReport as StepReport
    from warpgs.pipeline.train.settings import FitConfig as FitConfig
    from warpgs.pipeline.train.strategies.base import Strategy as Strategy
    from warpgs.pipeline.train.view_modules import ViewModule as ViewModule
    from warpgs.render.graphed import clear_graph_cache as clear_graph_cache
    from warpgs.render.options import RasterizeOptions as RasterizeOptions
    from warpgs.render.rasterize import rasterize as rasterize, select_rule as select_rule
    from warpgs.scene import (
        ActivatedGaussians as ActivatedGaussians,
        Camera as Camera,
        CovarianceGaussians as CovarianceGaussians,
        Gaussians as Gaussians,
        GivenDepth as GivenDepth,
        Normalization as Normalization,
        PointCloud as PointCloud,
        Render as Render,
        Scene as Scene,
        View as View,
    )
    from warpgs.synthetic.demo import write_demo as write_demo
else:
    __getattr__, __dir__ = lazy(__name__)
