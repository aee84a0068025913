"""The paper's strategy: pixels are sampled in proportion to importance, within a gate (Geometric-Aware Sampling)."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import torch

from warpgs.device import STEP, Needs, StepSizes
from warpgs.pipeline.paper import scores
from warpgs.pipeline.train.strategies.base import StrategyContext, register
from warpgs.pipeline.train.strategies.sampling import Rendered, Sampling
from warpgs.pipeline.train.views import TrainingView
from warpgs.schema import Checked, Within


@dataclass(frozen=True)
class PaperConfig(Checked, group="paper."):
    """Switches and settings of the paper's parts (its Table 2); the two layers (Hier) are the setting ``method.hier``."""

    s_render: bool = True
    """Use the rendering residual in the importance."""
    s_semantic: bool = True
    """Use the semantic score in the importance."""
    s_geometry: bool = True
    """Use the geometric score in the importance. With gate_quantile above 0, the reliability gate uses the score even if this
    is off."""
    ra: bool = True
    """Reliability gate: sample only pixels above gate_quantile of the geometric score. With depth consistent, views with
    consistent depth are also sampled only where it exists."""
    agp: bool = True
    """Adaptive Gaussian placement: sample pixels at random in proportion to importance. If off, take the pixels of highest
    importance."""
    pm: bool = True
    """Protection mechanism: new fine Gaussians keep a minimum opacity and are not pruned."""
    residual: Annotated[str, ("length", "gain")] = "length"
    """Rendering residual: length, the length of the colour difference in the view (the paper); or gain, the estimated decrease
    of the squared error over all training views by a fine Gaussian at the pixel."""
    depth: Annotated[str, ("rendered", "consistent")] = "rendered"
    """Depth of new Gaussians: rendered (the paper), or consistent, the initial depth that other views confirm."""
    gate_quantile: Annotated[float, Within(0, 1, ")")] = 0.6
    """Quantile of a view's geometric score above which a pixel is reliable, in [0, 1) (tau_geometry); 0 to disable."""

    def weights(self, semantics: bool = True) -> tuple[float, float, float]:
        """Return the weights of the three scores, scaled to sum to 1; ``semantics`` is False for a view without the second."""
        return scores.weights(self.s_render, self.s_semantic and semantics, self.s_geometry)

    @property
    def asked_quantile(self) -> float:
        """Requested quantile of the geometric score for the gate; 0 for no such gate."""
        return self.gate_quantile if self.ra else 0.0


UNIFORM = PaperConfig(s_render=False, s_semantic=False, s_geometry=False, depth="consistent", gate_quantile=0.0)
"""Settings with which this strategy is `Sampling`."""


@register("paper")
class Paper(Sampling):
    """Importance sampling by the paper on multimodal priors: residual, semantics and geometry, with a reliability gate."""

    Config = PaperConfig

    def __init__(self, context: StrategyContext):
        """Begin without scores."""
        super().__init__(context)
        c = self.config
        self.consistent, self.gated, self.at_random, self.protects = c.depth == "consistent", c.ra, c.agp, c.pm
        self.prunes_unseen = c == UNIFORM
        self.scored, self.asked_quantile = sum(c.weights()) > 0, c.asked_quantile
        self.semantic: list[torch.Tensor | None] = []
        """S_semantic of each training view, [H, W] in [0, 1]; None where its prior has no semantics."""
        self.geometry: list[torch.Tensor] = []
        """S_geometry of each training view, [H, W] in [0, 1]."""
        self.residuals: list[scores.Residual] = []
        """Residuals of the views of an event, to compute gains; empty if the residual is a length."""

    @classmethod
    def needs_priors(cls, own: PaperConfig) -> bool:
        """Return whether an event reads the semantic or the geometric score, which are computed from priors."""
        _, semantic, geometry = own.weights()
        return semantic > 0 or geometry > 0 or own.asked_quantile > 0

    def bytes(self, sizes: StepSizes) -> Needs:
        """Return the bytes of an event, and of both scores of every view at any time."""
        kept = 2 * 4 * sizes.pixels * sizes.views * self.needs_priors(self.config)  # float32
        return {moment: kept + n for moment, n in (dict.fromkeys(STEP, 0) | super().bytes(sizes)).items()}

    def setup(self) -> None:
        """Compute the semantic and the geometric score of each view, which do not change during the fit."""
        for view, prior in zip(self.context.views, self.context.priors):
            given = (prior.disparity, prior.confidence, prior.boundary, prior.foreground)
            disparity, *maps = (torch.as_tensor(m, dtype=torch.float32, device=view.image.device) for m in given)
            self.geometry.append(scores.geometry_score(disparity, None if view.countable is None else view.countable > 0))
            semantic = scores.semantic_score(*maps)
            self.semantic.append(semantic if bool(semantic.any()) else None)

    def before_event(self, views: Mapping[int, TrainingView], rendered: Mapping[int, Rendered]) -> None:
        """Compute the residuals of all views of an event, if gains are the first score."""
        self.residuals = []
        if self.config.residual == "gain" and self.config.weights()[0] > 0:
            footprint = self.method.sampler.footprint
            self.residuals = [scores.residual_of(v, rendered[i].rgb, rendered[i].surface, footprint) for i, v in views.items()]

    def importance(self, number: int, view: TrainingView, rendered: Rendered) -> dict[str, torch.Tensor]:
        """Return S_render, S_semantic, S_geometry and S_importance of a view, [H, W] each; nothing if all weights are 0."""
        rgb, _, depth, valid = rendered
        semantic = self.semantic[number] if self.semantic else None
        by = self.config.weights(semantic is not None)
        if sum(by) == 0:
            return {}
        residual = scores.render_score(rgb, view.image, valid)
        if self.residuals:
            residual = scores.normalized(scores.gain_map(view, depth, valid, self.residuals), valid)
        zeros = torch.zeros_like(depth)
        parts = (residual, zeros if semantic is None else semantic, self.geometry[number] if self.geometry else zeros)
        names = (f"{w:.2f} {n}" for w, n in zip(by, ("S_render", "S_semantic", "S_geometry")))
        return dict(zip(names, parts)) | {"S_importance": scores.importance(parts, by)}

    def gate(self, number: int, valid: torch.Tensor, wanted: int) -> tuple[torch.Tensor, float]:
        """Return M_reliable of a view, bool [H, W], and the quantile of S_geometry that was used."""
        geometry = self.geometry[number] if self.geometry else torch.zeros_like(valid, dtype=torch.float32)
        return scores.geometry_gate(geometry, valid, self.asked_quantile, wanted)
