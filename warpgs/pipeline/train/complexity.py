"""The size of a model, in figures and in one line."""

from __future__ import annotations

from warpgs.pipeline.model.compress import stored_degrees
from warpgs.pipeline.model.sh_degrees import model_bytes
from warpgs.pipeline.train.trainer import Trainer
from warpgs.runtime.byte_units import format_bytes


def complexity_figures(trainer: Trainer) -> dict:
    """Return the size of a model for metrics.json: its Gaussians, mean degree and bytes, and why growth ended."""
    degrees = stored_degrees(trainer.gaussians.sh)
    figures = {
        "count": len(degrees), "mean_degree": float(degrees.double().mean()), "bytes": model_bytes(degrees),
        "cap": trainer.config.max_gaussians, "held_out": False, "why": "growth ended by schedule", "marginal_db": None,
    }  # fmt: skip
    return {"complexity": figures | trainer.stopping.figures()}


def complexity_summary(figures: dict) -> str:
    """Return the values of `complexity_figures` as one line for the user."""
    f = figures["complexity"]
    text = f"{f['count']:,} Gaussians of mean SH degree {f['mean_degree']:.2f}, {format_bytes(f['bytes'])} uncompressed"
    if f["marginal_db"] is not None:
        text += f"; left-out blocks gained {f['marginal_db']:+.3f} dB between the last two measurements"
    return f"{text}; growth stopped because {f['why']}" if f["held_out"] else f"{text}; {f['why']}"
