"""The size of a model, in figures and in one line."""

from __future__ import annotations

from warpgs.pipeline.model.compress import stored_degrees
from warpgs.pipeline.model.parameter_bounds import model_bytes
from warpgs.pipeline.train.trainer import Trainer
from warpgs.runtime.byte_units import format_bytes


def complexity_figures(trainer: Trainer) -> dict:
    """Return the size of a model for metrics.json: its Gaussians, mean degree and bytes, and why growth ended."""
    degrees = trainer.table.columns.get("max_degree")
    degrees = stored_degrees(trainer.gaussians.sh) if degrees is None else degrees
    figures = {
        "count": len(degrees), "mean_degree": float(degrees.double().mean()), "bytes": model_bytes(degrees),
        "cap": trainer.config.max_gaussians, "holdout": False, "why": "growth ended by schedule", "marginal_db": None,
    }  # fmt: skip
    return {"complexity": figures | trainer.strategy.figures()}


def complexity_summary(figures: dict) -> str:
    """Return one line for people from the figures of `complexity_figures`."""
    f = figures["complexity"]
    text = f"{f['count']:,} Gaussians of mean SH degree {f['mean_degree']:.2f}, {format_bytes(f['bytes'])} uncompressed"
    if f["marginal_db"] is not None:
        text += f"; the last level gained {f['marginal_db']:+.3f} dB on held-out blocks"
    return f"{text}; growth stopped because {f['why']}" if f["holdout"] else f"{text}; {f['why']}"
