"""Public names for strategies, loss terms and view modules of your own."""

from typing import TYPE_CHECKING

from warpgs.faces import lazy

if TYPE_CHECKING:
    from warpgs.device import STEP as STEP, Needs as Needs, StepSizes as StepSizes
    from warpgs.geometry import back_project_tensors as back_project_tensors, project_tensors as project_tensors
    from warpgs.kernels.ssim import ssim as ssim
    from warpgs.kernels.update import Setting as Setting
    from warpgs.pipeline.metrics.scores import quantiles as quantiles
    from warpgs.pipeline.model.start import InitConfig as InitConfig
    from warpgs.pipeline.model.table import Column as Column, DensityUpdate as DensityUpdate, Table as Table
    from warpgs.pipeline.train.loss import (
        LossInputs as LossInputs,
        LossTerm as LossTerm,
        Target as Target,
        photometric_loss as photometric_loss,
        register_loss_term as register_loss_term,
        total as total,
    )
    from warpgs.pipeline.train.memory import most_instances as most_instances
    from warpgs.pipeline.train.schedule import OptimizerConfig as OptimizerConfig, Phases as Phases
    from warpgs.pipeline.train.step import captured_renderer as captured_renderer, eager_renderer as eager_renderer
    from warpgs.pipeline.train.strategies.base import (
        Growth as Growth,
        Settings as Settings,
        Strategy as Strategy,
        StrategyContext as StrategyContext,
        register_strategy as register_strategy,
    )
    from warpgs.pipeline.train.strategies.clone_split import CloneSplit as CloneSplit, GradientGrowth as GradientGrowth
    from warpgs.pipeline.train.strategies.sampling import Rendered as Rendered, Sampling as Sampling
    from warpgs.pipeline.train.view_modules import (
        FittedViews as FittedViews,
        ViewModule as ViewModule,
        register_view_module as register_view_module,
    )
    from warpgs.pipeline.train.views import LearnedView as LearnedView, TrainingView as TrainingView
    from warpgs.ranks import join_ranks as join_ranks
    from warpgs.scene import Prior as Prior, Tensors as Tensors
    from warpgs.schema import Checked as Checked, Within as Within, state_schema as state_schema
else:
    __getattr__, __dir__ = lazy(__name__)
