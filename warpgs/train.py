"""Public names for strategies, loss terms and view modules of your own."""

from typing import TYPE_CHECKING

from warpgs.faces import lazy

__all__ = [
    "STEP",
    "Checked",
    "CloneSplit",
    "Column",
    "DensityUpdate",
    "FittedViews",
    "GradientGrowth",
    "Growth",
    "InitConfig",
    "LearnedView",
    "LossInputs",
    "LossTerm",
    "Needs",
    "OptimizerConfig",
    "Phases",
    "Prior",
    "Rendered",
    "Sampling",
    "Setting",
    "Settings",
    "StepSizes",
    "Strategy",
    "StrategyContext",
    "Table",
    "Target",
    "Tensors",
    "TrainingView",
    "ViewModule",
    "Within",
    "back_project_tensors",
    "captured_renderer",
    "eager_renderer",
    "join_ranks",
    "most_instances",
    "photometric_loss",
    "project_tensors",
    "quantiles",
    "register_loss_term",
    "register_strategy",
    "register_view_module",
    "ssim",
    "state_schema",
    "total",
]

if TYPE_CHECKING:
    from warpgs.device import STEP, Needs, StepSizes
    from warpgs.geometry import back_project_tensors, project_tensors
    from warpgs.kernels.ssim import ssim
    from warpgs.kernels.update import Setting
    from warpgs.pipeline.metrics.scores import quantiles
    from warpgs.pipeline.model.start import InitConfig
    from warpgs.pipeline.model.table import Column, DensityUpdate, Table
    from warpgs.pipeline.train.loss import LossInputs, LossTerm, Target, photometric_loss, register as register_loss_term, total
    from warpgs.pipeline.train.memory import most_instances
    from warpgs.pipeline.train.schedule import OptimizerConfig, Phases
    from warpgs.pipeline.train.step import captured_renderer, eager_renderer
    from warpgs.pipeline.train.strategies.base import Growth, Settings, Strategy, StrategyContext, register as register_strategy
    from warpgs.pipeline.train.strategies.clone_split import CloneSplit, GradientGrowth
    from warpgs.pipeline.train.strategies.sampling import Rendered, Sampling
    from warpgs.pipeline.train.view_modules import FittedViews, ViewModule, register as register_view_module
    from warpgs.pipeline.train.views import LearnedView, TrainingView
    from warpgs.ranks import join as join_ranks
    from warpgs.scene import Prior, Tensors
    from warpgs.schema import Checked, Within, fields as state_schema
else:
    __getattr__, __dir__ = lazy(__name__)
