"""Figures of a step, for those who follow a fit."""

from dataclasses import dataclass


@dataclass(frozen=True)
class StepReport:
    """Figures of one step."""

    step: int
    """Steps done, from 1."""
    loss: float
    """Loss on the step's view, the mean over its views where it has several."""
    psnr: float
    """PSNR on the step's view before the update, of the mean squared error over its views where it has several [dB]."""
    count: int
    """Number of Gaussians after the step."""
    seconds: float
    """Wall time of the step [s]."""
