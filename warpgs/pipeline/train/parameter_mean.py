"""Mean of the parameters over the last steps of a fit; after the last step it replaces the parameters.

A step of one view moves the parameters towards that view, so the parameters of the last step favour the last views. The mean
over many steps does not (Polyak and Juditsky 1992; Izmailov et al. 2018, arXiv 1803.05407).
docs/decisions/029-mean-of-the-last-steps.md has measurements.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch

from warpgs.errors import DataError

SAMPLES = 32
"""Least number of samples of a mean; a shorter mean takes every step."""
PREFIX = "mean."
"""Beginning of the names of stored tensors."""


class ParameterMean:
    """Sum of the parameters after evenly spaced steps near the end of a fit.

    Sums are in float32. With n samples, fewer than 2 `SAMPLES`, a mean has a rounding error of at most n 2^-24 of the largest
    sample: 4e-6 at most, and about 1e-7 in practice, which is as much as the rounding of the parameters themselves.
    """

    def __init__(self, fraction: float):
        """Begin without a sample; ``fraction`` of the steps, the last ones, are averaged, in [0, 1]; 0 for no mean."""
        self.fraction, self.count = fraction, 0
        self.sums: dict[str, torch.Tensor] = {}

    def samples(self, steps: int) -> range:
        """Return the steps after which a fit of ``steps`` steps takes a sample: the last one, and evenly spaced ones before."""
        length = int(self.fraction * steps)
        return range(steps, steps - length, -max(1, length // SAMPLES))

    def wait(self, step: int, steps: int) -> int:
        """Return the number of steps from ``step`` to the next sample; without one, to the end of the fit."""
        return min((s - step for s in self.samples(steps) if s > step), default=steps - step)

    @torch.no_grad()
    def update(self, step: int, steps: int, params: Mapping[str, torch.Tensor]) -> bool:
        """Take a sample if it is due; after the last step, replace the parameters by the mean.

        Args:
            step: Steps taken.
            steps: Steps of the fit.
            params: Parameters by name, of any shape [...]; replaced in place.

        Returns:
            Whether the parameters were replaced.
        """
        if step not in self.samples(steps):
            return False
        for name, value in params.items():
            if self.count:
                self.sums[name] += value
            else:
                self.sums[name] = value.detach().clone()
        self.count += 1
        if step < steps:
            return False
        for name, value in params.items():
            value.detach().copy_(self.sums[name].div_(self.count))
        self.restart()
        return True

    def restart(self) -> None:
        """Forget all samples: the set of Gaussians changed, and rows are no longer the same Gaussians."""
        self.sums, self.count = {}, 0

    def state(self) -> dict[str, torch.Tensor]:
        """Return tensors by name, of any shape [...], from which the mean continues; empty without samples."""
        if not self.count:
            return {}
        count = torch.tensor([self.count], dtype=torch.int64, device="cpu")
        return {f"{PREFIX}{n}": t for n, t in self.sums.items()} | {f"{PREFIX}count": count}

    def load(self, tensors: Mapping[str, torch.Tensor], params: Mapping[str, torch.Tensor]) -> None:
        """Load what `state` returned.

        Args:
            tensors: Tensors by name, of any shape [...]; other names are ignored.
            params: Current parameters by name, of the shapes [...] of the sums.

        Raises:
            DataError: A sum is missing, unknown, or of another shape or type than its parameter, or the count is invalid.
        """
        self.restart()
        stored = {n.removeprefix(PREFIX): t for n, t in tensors.items() if n.startswith(PREFIX)}
        if not stored:
            return
        count = stored.pop("count", None)
        kinds = {n: (t.shape, t.dtype) for n, t in stored.items()}
        whole = count is not None and count.shape == (1,) and count.dtype == torch.int64 and int(count) > 0
        if not whole or kinds != {n: (t.shape, t.dtype) for n, t in params.items()}:
            raise DataError(
                "the stored mean of the parameters is damaged, or does not belong to these parameters; restore the file, or "
                "fit the scene again"
            )
        assert count is not None
        self.count = int(count)
        self.sums = {n: t.to(params[n].device).clone() for n, t in stored.items()}
