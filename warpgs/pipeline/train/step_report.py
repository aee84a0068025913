"""Results of a step, for callbacks and displays."""

from dataclasses import dataclass


@dataclass(frozen=True)
class StepReport:
    """Results of one step."""

    step: int
    """Steps done, from 1."""
    loss: float
    """Loss on the view of the step; with several views, the mean."""
    psnr: float
    """PSNR on the view of the step before the update [dB]; with several views, the PSNR of their mean squared error."""
    count: int
    """Number of Gaussians after the step."""
    seconds: float
    """Wall time of the step [s]."""
