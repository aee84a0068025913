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
from warpgs.pipeline.model.scale_limits import LimitConfig
from warpgs.pipeline.train.background import color_of
from warpgs.pipeline.train.loss import LOSS_TERMS, LossConfig, LossTerm, check_terms
from warpgs.pipeline.train.schedule import OptimizerConfig, PhaseConfig
from warpgs.pipeline.train.strategies.base import STRATEGIES, find_strategy
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.strategies.holdout_blocks import HoldoutConfig
from warpgs.pipeline.train.strategies.importance_sampling import MethodConfig
from warpgs.pipeline.train.strategies.sampler import SamplerConfig
from warpgs.priors.view_prior import PriorConfig
from warpgs.schema import SchemaError, anything, mapping, of_type


@dataclass(frozen=True)
class FitConfig:
    """All settings of a fit."""

    preset: str = "3dgs"
    """Named set of settings that the others start from: default, quick, 3dgs, mcmc or paper-literal."""
    steps: int | None = 7000
    """Number of optimisation steps; strategy holdout may end earlier. None: by the number of views."""
    batch: int = 1
    """Views that each step renders; its gradient is their mean. Learning rates are those of one view times the square root of
    this (docs/many-gpus.md). Several GPUs share the views of a step."""
    cpu_limit: bool = True
    """Take no more steps on a CPU than two cores do in 1 to 20 minutes, where the steps follow from the number of views."""
    seed: int = 0
    """Seed of every random choice; the same seed, data and kind of device give the same bytes."""
    rule: str = "exact"
    """Cut-offs of the rasterizer: exact, balanced, fast, gsplat or inria."""
    half_resolution: float | None = 0.0
    """Fraction of the steps, from the first, in which views are fitted at half their size (docs/trade.md). None: by the number
    of views."""
    sh_every: int = 1000
    """Number of steps after which the spherical-harmonics degree in use rises by one."""
    dropout: float = 0.0
    """Probability, at the last step, that a Gaussian is hidden for a step; it grows linearly from 0 (DropGaussian, Park et
    al. 2025)."""
    dropout_views: int = 3
    """Number of training views up to which dropout has its full probability; with more it is lower in proportion."""
    checkpoint_every: int = 1000
    """Number of steps at whose multiples a checkpoint may be written; one is written at the end in any case."""
    checkpoint_seconds: float = 20.0
    """Least time from one checkpoint to the next [s], since writing takes time. No result depends on it."""
    memory_limit: int | None = None
    """Bytes that the tensors of the fit may take on its device during steps; None for no limit. With one, densification stops
    before a step would exceed it, and images are rendered in chunks where a whole one would."""
    cuda_graph: bool = True
    """CUDA graphs: a step is captured once and replayed; the same kernels and the same bytes as without, in less time."""
    refine_poses: bool = False
    """Learn an increment of each training camera but the first with the Gaussians, for poses that are a little off
    (docs/your-photos.md)."""
    exposure: bool = False
    """Learn an affine map of colours for each training view with the Gaussians, for photographs that differ in brightness or
    white balance; no held-out view has one (docs/your-photos.md)."""
    max_gaussians: int = 1_000_000
    """Largest number of Gaussians, from the start on."""
    background: str = "scene"
    """Colour behind the scene, where no Gaussian lies: auto (the mean colour of the training views where they are opaque and
    show no object on black, else as scene), mean, scene (that of the files: white for Blender, else black), black, white,
    #rrggbb, or r,g,b in [0, 1]."""
    strategy: str = "clone_split"
    """Density strategy, which adds and removes Gaussians: clone_split, importance_sampling, holdout (held-out blocks of the
    training views decide how many there are and of which degree, docs/complexity.md), mcmc, or your own as module:Class or
    path/to/file.py:Class."""
    strategy_config: Any = None
    """Own settings of the strategy, an instance of its ``Config``; None for their defaults. Those of clone_split,
    importance_sampling and holdout are the groups ``density``, ``method`` and ``holdout``."""
    loss_terms: tuple[LossTerm, ...] = ()
    """Loss terms beside those of ``loss``; the class of each is registered by a name."""
    holdout: HoldoutConfig = field(default_factory=HoldoutConfig)
    """Settings of strategy holdout."""
    init: InitConfig = field(default_factory=InitConfig)
    """Source and first values of the Gaussians."""
    loss: LossConfig = field(default_factory=LossConfig)
    """Weights of the built-in loss terms."""
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    """Learning rates."""
    density: DensityConfig = field(default_factory=DensityConfig)
    """Settings of cloning, splitting and pruning (strategies clone_split, importance_sampling and holdout)."""
    limits: LimitConfig = field(default_factory=LimitConfig)
    """Limits of the size and the shape of every Gaussian."""
    phases: PhaseConfig = field(default_factory=PhaseConfig)
    """Lengths of the three phases, and times of sampling."""
    method: MethodConfig = field(default_factory=MethodConfig)
    """Settings of strategies importance_sampling and holdout."""
    priors: PriorConfig = field(default_factory=PriorConfig)
    """Networks that priors of the views come from."""

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "sh_every", "checkpoint_every", "dropout_views", "max_gaussians"):
            if getattr(self, name) is not None and getattr(self, name) < 1:
                raise UsageError(f"{name.replace('_', '-')} must be at least 1, not {getattr(self, name)}")
        if not 0 <= self.seed < 2**31:
            raise UsageError(f"seed must be a whole number from 0 to 2^31 - 1, not {self.seed}")
        if self.memory_limit is not None and not self.memory_limit >= 1:
            raise UsageError(f"memory-limit must be at least one byte, not {self.memory_limit}")
        if not self.checkpoint_seconds >= 0:
            raise UsageError(f"checkpoint-seconds must be at least 0, not {self.checkpoint_seconds}")
        if self.half_resolution is not None and not 0 <= self.half_resolution <= 1:
            raise UsageError(f"half-resolution must lie in [0, 1], not {self.half_resolution}")
        if not 0 <= self.dropout < 1:
            raise UsageError(f"dropout must lie in [0, 1), not {self.dropout}")
        if self.rule not in RULES:
            raise UsageError(f"rule {self.rule!r} is not one of {', '.join(RULES)}")
        color_of(self.background)
        check_terms(self.loss_terms)
        if isinstance(self.strategy, type):
            object.__setattr__(self, "strategy", STRATEGIES.name_of(self.strategy))
        own = find_strategy(self.strategy).Config if STRATEGIES.knows(self.strategy) else None
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
            SchemaError: A value is of another kind than its field.
            UsageError: A field is unknown, a value is out of range, or a class of the user's own was not loaded here.
        """
        mapping(anything)(values, "config")
        try:
            values = dict(values)
            terms = tuple(_term(dict(t)) for t in values.pop("loss_terms"))
            own = values.pop("strategy_config")
            kind = find_strategy(values["strategy"]).Config
            if own is not None and kind is None:
                raise SchemaError(f"strategy_config must be null for strategy {values['strategy']}")
            own = own if kind is None or own is None else _compose(kind, own, "strategy_config")
            config: FitConfig = _compose(FitConfig, values | {"loss_terms": terms, "strategy_config": own}, "config")
            return config
        except (TypeError, KeyError) as e:
            raise UsageError(f"the stored configuration is of another version of warpgs ({e})") from e

    def fingerprint(self) -> str:
        """Return the first 12 hexadecimal digits of the SHA-256 of the settings."""
        return hashlib.sha256(json.dumps(self.to_json(), sort_keys=True).encode()).hexdigest()[:12]


def _term(values: dict[str, Any]) -> LossTerm:
    term: LossTerm = _compose(LOSS_TERMS.find(values.pop("name")), values, "loss_terms")
    return term


def _compose(kind: type, values: dict[str, Any], place: str) -> Any:
    """Return a settings dataclass from nested plain values; its fields that are dataclasses are composed in turn.

    Raises:
        SchemaError: A value is of another kind than its field.
    """
    mapping(anything)(values, place)
    kinds, composed = typing.get_type_hints(kind), {}
    for name, value in values.items():
        where, of = f"{place}.{name}", kinds.get(name, Any)
        if isinstance(of, type) and dataclasses.is_dataclass(of):
            composed[name] = _compose(of, value, where)
        elif name not in ("loss_terms", "strategy_config"):  # these two are composed before
            of_type(of)(list(value) if isinstance(value, tuple) else value, where)
            listed = any(typing.get_origin(part) is tuple for part in (of, *typing.get_args(of)))
            composed[name] = tuple(value) if listed and isinstance(value, list) else value
        else:
            composed[name] = value
    return kind(**composed)


_DEFAULT = FitConfig(
    preset="default", background="auto", steps=None, half_resolution=None, sh_every=500, dropout=0.6, strategy="holdout",
    phases=PhaseConfig(coarse=2000, stable=3000, least=20),
    init=InitConfig(sweep_up_to=1000, max_sh_degree=None, merge_px=8, fill_px=32),
    optimizer=OptimizerConfig(scales_lr=None, scales_decay=0.1, opacities_lr=None), density=DensityConfig(gradient=5e-4),
    holdout=HoldoutConfig(bounds=False, degrees=False, trim_db=0, levels=12, stop_db=0.1),
    method=MethodConfig(
        events=True, hier=True,
        sampler=SamplerConfig(depth="consistent", fraction=0.02, footprint=3.0, gate_quantile=0.0, max_fraction=2.0),
    ),
)  # fmt: skip

PRESETS: dict[str, FitConfig] = {
    "default": _DEFAULT,
    "quick": dataclasses.replace(_DEFAULT, preset="quick"),
    "3dgs": FitConfig(limits=LimitConfig(max_size=0, max_ratio=0, max_reach=0)),
    "mcmc": FitConfig(
        preset="mcmc", strategy="mcmc", init=InitConfig(opacity=0.5, scale_factor=0.1),
        optimizer=OptimizerConfig(scales_lr=0.005), limits=LimitConfig(max_size=0, max_ratio=0, max_reach=0),
    ),
    "paper-literal": FitConfig(
        preset="paper-literal", strategy="importance_sampling", steps=30_000, sh_every=500,
        init=InitConfig(source="flow", merge_px=0, fill_px=0), optimizer=OptimizerConfig(scales_lr=0.03),
        density=DensityConfig(gradient=5e-4, stop_fraction=1.0, reset_every=3000, reset_opacity=0.05, prune_size=0),
        phases=PhaseConfig(coarse=2000, stable=3000), method=MethodConfig(events=True, hier=True),
    ),
}  # fmt: skip
"""Presets by name; `PRESET_NOTES` describes them."""

DEFAULT_PRESET = "default"
"""Preset where the user names none."""

PRESET_NOTES: dict[str, str] = {
    "default": "any capture: steps, degree and rates follow from the number of views, and the fit ends when it gains no more",
    "quick": "a first look: the same in at most 600 steps",
    "3dgs": "a baseline: Kerbl et al. 2023 without opacity resets, which cost decibels when views are few",
    "mcmc": "a baseline: Kheradmand et al. 2024, which fills a given number of Gaussians, from the same points as 3dgs",
    "paper-literal": "the paper to the letter, with first proposals for what it leaves open; slow",
}
"""One description of each preset."""


def preset_config(config: FitConfig | str | None) -> FitConfig:
    """Return the settings for a preset's name, for settings themselves, or for None: the default preset.

    Raises:
        UsageError: There is no such preset.
    """
    if isinstance(config, FitConfig):
        return config
    name = DEFAULT_PRESET if config is None else config
    if name not in PRESETS:
        raise UsageError(f"preset {name!r} is not one of {', '.join(PRESETS)}")
    return PRESETS[name]
