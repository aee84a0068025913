"""All settings of a fit, composed of the dataclasses that live beside the code which reads them; and the presets."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import typing
from dataclasses import dataclass, field
from typing import Any

from warpgs.constants import RULES
from warpgs.errors import UsageError
from warpgs.pipeline.model.init import InitConfig
from warpgs.pipeline.train.loss import LOSS_TERMS, LossConfig, LossTerm
from warpgs.pipeline.train.schedule import OptimizerConfig, PhaseConfig
from warpgs.pipeline.train.strategies.base import find_strategy
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.strategies.holdout_blocks import HoldoutConfig
from warpgs.pipeline.train.strategies.importance_sampling import MethodConfig
from warpgs.pipeline.train.strategies.sampler import SamplerConfig
from warpgs.priors.view_prior import PriorConfig


@dataclass(frozen=True)
class FitConfig:
    """All settings of a fit."""

    preset: str = "3dgs"
    """Named set of settings that the others start from; see `warpgs fit --help`."""
    steps: int = 7000
    """Optimisation steps, one view each."""
    seed: int = 0
    """Decides every random choice; the same seed, data and device kind give the same bytes."""
    rule: str = "exact"
    """Cut-offs of the rasterizer: exact, balanced, fast, gsplat or inria."""
    half_resolution: float = 0.0
    """Fraction of the steps, from the first, in which views are fitted at half their size (docs/trade.md)."""
    sh_every: int = 1000
    """Steps after which the spherical-harmonics degree in use rises by one."""
    dropout: float = 0.0
    """Probability, at the last step, that a Gaussian is hidden for a step; it grows linearly from 0 (DropGaussian, Park et
    al. 2025)."""
    dropout_views: int = 3
    """With more training views than this the probability is lower in proportion: they hold the Gaussians in place."""
    checkpoint_every: int = 1000
    """A checkpoint may be written at multiples of this step; one is written at the end in any case."""
    checkpoint_seconds: float = 20.0
    """Time from one checkpoint to the next at the least [s]: writing takes time too. No result depends on it."""
    memory_limit: int | None = None
    """Bytes that the fit's tensors may take on its device while it takes steps; None for no limit. With one, densification
    stops where a step would not fit, and pictures are drawn in bands where a whole one would not."""
    cuda_graph: bool = True
    """On CUDA, record a step once and replay it; the same kernels and the same bytes as without, in less time."""
    max_gaussians: int = 1_000_000
    """No more Gaussians than this, from the start on."""
    strategy: str = "clone_split"
    """Where Gaussians are added and removed: clone_split, importance_sampling, holdout (held-out blocks of the training views
    decide how many there are and of which degree, docs/complexity.md), mcmc, or module:Class of your own."""
    strategy_config: Any = None
    """Settings of the strategy's own, its ``Config``; None for their defaults. Those of clone_split, importance_sampling and
    holdout are the groups below."""
    loss_terms: tuple[LossTerm, ...] = ()
    """Terms that the loss has beside those of ``loss``."""
    holdout: HoldoutConfig = field(default_factory=HoldoutConfig)
    init: InitConfig = field(default_factory=InitConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    density: DensityConfig = field(default_factory=DensityConfig)
    phases: PhaseConfig = field(default_factory=PhaseConfig)
    method: MethodConfig = field(default_factory=MethodConfig)
    priors: PriorConfig = field(default_factory=PriorConfig)

    def __post_init__(self) -> None:
        for name in ("steps", "sh_every", "checkpoint_every", "dropout_views", "max_gaussians"):
            if getattr(self, name) < 1:
                raise UsageError(f"{name.replace('_', '-')} must be at least 1, not {getattr(self, name)}")
        if not 0 <= self.seed < 2**31:
            raise UsageError(f"seed must be a whole number from 0 to 2^31 - 1, not {self.seed}")
        if self.memory_limit is not None and not self.memory_limit >= 1:
            raise UsageError(f"memory-limit must be at least one byte, not {self.memory_limit}")
        if not self.checkpoint_seconds >= 0:
            raise UsageError(f"checkpoint-seconds must be at least 0, not {self.checkpoint_seconds}")
        if not 0 <= self.half_resolution <= 1:
            raise UsageError(f"half-resolution must lie in [0, 1], not {self.half_resolution}")
        if not 0 <= self.dropout < 1:
            raise UsageError(f"dropout must lie in [0, 1), not {self.dropout}")
        if self.rule not in RULES:
            raise UsageError(f"rule {self.rule!r} is not one of {', '.join(RULES)}")
        own = None if ":" in self.strategy else find_strategy(self.strategy).Config
        if own is not None and self.strategy_config is None:
            object.__setattr__(self, "strategy_config", own())

    def to_json(self) -> dict[str, Any]:
        """Return nested plain values, as stored in a run folder."""
        terms = [{"name": t.name, **dataclasses.asdict(t)} for t in self.loss_terms]
        return dataclasses.asdict(dataclasses.replace(self, loss_terms=())) | {"loss_terms": terms}

    @staticmethod
    def from_json(values: dict[str, Any]) -> FitConfig:
        """Return the configuration that `to_json` stored.

        Raises:
            UsageError: A field is unknown, or a class of the user's own was not loaded in this process.
        """
        try:
            values = dict(values)
            terms = tuple(_term(dict(t)) for t in values.pop("loss_terms"))
            own = values.pop("strategy_config")
            kind = find_strategy(values["strategy"]).Config
            own = own if own is None or kind is None else kind(**own)
            config: FitConfig = _compose(FitConfig, values | {"loss_terms": terms, "strategy_config": own})
            return config
        except (TypeError, KeyError) as e:
            raise UsageError(f"the stored configuration is of another version of warpgs ({e})") from e

    def fingerprint(self) -> str:
        """Return the first 12 hexadecimal digits of the SHA-256 of the settings."""
        return hashlib.sha256(json.dumps(self.to_json(), sort_keys=True).encode()).hexdigest()[:12]


def _term(values: dict[str, Any]) -> LossTerm:
    return LOSS_TERMS.find(values.pop("name"))(**values)


def _compose(kind: type, values: dict[str, Any]) -> Any:
    """Return a settings dataclass from nested plain values; its fields that are dataclasses are composed in turn."""
    kinds = typing.get_type_hints(kind)
    return kind(**{k: _compose(kinds[k], v) if dataclasses.is_dataclass(kinds[k]) else v for k, v in values.items()})


_SPARSE = FitConfig(
    preset="strong-3dgs", steps=3000, sh_every=500, dropout=0.6, phases=PhaseConfig(coarse=2000, stable=3000),
    init=InitConfig(sweep_up_to=30, max_sh_degree=1, merge_px=8, fill_px=32),
    optimizer=OptimizerConfig(scales_lr=0.1, scales_decay=0.1), density=DensityConfig(gradient=5e-4),
)  # fmt: skip
_PAPER = dataclasses.replace(
    _SPARSE, preset="paper", strategy="importance_sampling",
    method=MethodConfig(
        events=True, hier=True,
        sampler=SamplerConfig(depth="consistent", fraction=0.02, footprint=3.0, gate_quantile=0.0, max_fraction=2.0),
    ),
)  # fmt: skip
_NEXUS = FitConfig(
    preset="nexusgs", steps=10_000, sh_every=500, init=InitConfig(source="flow", merge_px=0, fill_px=0),
    optimizer=OptimizerConfig(scales_lr=0.03),
    density=DensityConfig(gradient=5e-4, stop_fraction=1.0, reset_every=3000, reset_opacity=0.05, prune_size=0),
)  # fmt: skip

PRESETS: dict[str, FitConfig] = {
    "paper": _PAPER,
    "quick": dataclasses.replace(
        _PAPER, preset="quick", steps=600, init=dataclasses.replace(_SPARSE.init, sweep_up_to=12)
    ),
    "balanced": dataclasses.replace(
        _PAPER, preset="balanced", steps=1200, half_resolution=0.3, init=dataclasses.replace(_SPARSE.init, sweep_up_to=12)
    ),
    "strong-3dgs": _SPARSE,
    "3dgs": FitConfig(),
    "mcmc": FitConfig(
        preset="mcmc", strategy="mcmc", init=InitConfig(opacity=0.5, scale_factor=0.1),
        optimizer=OptimizerConfig(scales_lr=0.005),
    ),
    "nexusgs": _NEXUS,
    "dropgaussian": FitConfig(
        preset="dropgaussian", steps=10_000, dropout=0.2, optimizer=OptimizerConfig(scales_lr=0.005),
        density=DensityConfig(gradient=5e-4, stop_fraction=1.0, prune_size=0),
    ),
    "fsgs": FitConfig(
        preset="fsgs", steps=10_000, sh_every=500, init=InitConfig(sweep_up_to=30), loss=LossConfig(depth_weight=0.05),
        optimizer=OptimizerConfig(scales_lr=0.005),
        density=DensityConfig(gradient=5e-4, stop_fraction=1.0, reset_every=3000, reset_opacity=0.05, prune_size=0),
    ),
    "paper-literal": dataclasses.replace(
        _NEXUS, preset="paper-literal", strategy="importance_sampling", steps=30_000,
        phases=PhaseConfig(coarse=2000, stable=3000), method=MethodConfig(events=True, hier=True),
    ),
}  # fmt: skip
"""paper: the method, with the constants of docs/decisions/008-method.md. quick: the same in a fifth of the steps; balanced: in
two fifths, the first at half size (docs/trade.md). strong-3dgs: the start, degree, rates, dropout and schedule of ``paper``,
none of its parts. 3dgs: Kerbl et al. 2023 without opacity resets, which cost decibels when views are few.
mcmc: Kheradmand et al. 2024, from the same points. nexusgs: Zheng et al.
2025, a start from flow with every pixel, and its resets. dropgaussian: Park et al. 2025. fsgs: our trainer with
the depth term, rates, threshold and resets of Zhu et al. 2024, without their unpooling and unseen views, from our own sweep.
paper-literal: the paper on ``nexusgs``, with what it leaves open as first proposed."""

DEFAULT_PRESET = {"cuda": "paper", "cpu": "quick"}
"""Preset where the user names none, by kind of device."""
