"""Projected means that hold their gradients after a backward pass, for density strategies."""

import copy
import functools
from collections.abc import Callable, Sequence
from typing import Any

import torch

from warpgs.errors import UsageError

PASSED = "_backward_passes"
"""Attribute of projected Gaussians: a list with an entry for each backward pass through them."""


class ProjectedMeans(torch.Tensor):
    """A tensor [C, N, 2] with an error message for a missing ``absgrad``; results of operations are plain tensors."""

    __torch_function__ = torch._C._disabled_torch_function_impl

    def __getattr__(self, name: str) -> Any:
        """Raise AttributeError; for ``absgrad``, the message names the missing option and backward pass."""
        if name != "absgrad":
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        raise AttributeError("means2d has no absgrad yet: it needs RasterizeOptions(absgrad=True) and a backward pass")

    def __deepcopy__(self, memo: dict[int, Any]) -> "ProjectedMeans":
        """Return a copy of the means and of their gradients so far; later backward passes do not change the copy."""
        copied = memo[id(self)] = self.detach().clone().as_subclass(ProjectedMeans)
        for name in ("grad", "absgrad"):
            if (found := getattr(self, name, None)) is not None:
                setattr(copied, name, found.clone())
        return copied

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Pickle the means and their ``absgrad``, but not their ``grad``, as for every tensor."""
        copied = copy.deepcopy(self)
        copied.grad = None
        return torch.Tensor.__reduce_ex__(copied, protocol)


def count_passes(projected: torch.Tensor, passes: list[bool] | None = None) -> None:
    """Count the backward passes through projected Gaussians [C, N, 12], for `projected_means`.

    Autograd nodes append an entry to the list ``passes`` in each pass; if it is None, a slower hook counts instead.
    """
    if not projected.requires_grad:
        return
    if passes is None:
        own: list[bool] = []
        passes = own
        projected.register_hook(lambda gradient: own.append(True))
    setattr(projected, PASSED, passes)


def projected_means(
    parts: Sequence[torch.Tensor], absgrad: bool, select: Callable[[torch.Tensor], torch.Tensor] = lambda values: values
) -> torch.Tensor:
    """Return the means of projected Gaussians, which hold their gradients after the next backward pass.

    ``parts`` [C, N, 12] are those of each scene; ``select`` picks or reshapes what is returned, from means [sum of C, N, 2].

    Raises:
        UsageError: A backward pass went through them already.
    """
    if any(getattr(part, PASSED, None) for part in parts):
        raise UsageError("read render.means2d before the backward pass: gradients of earlier passes are not kept")
    means2d = select(torch.cat([part.detach()[..., :2] for part in parts])).as_subclass(ProjectedMeans)
    columns = {"grad": slice(0, 2)} | ({"absgrad": slice(10, 12)} if absgrad else {})
    # a hook that held a part would be held by that part's graph: a cycle through C++ that nothing frees
    sizes = [part.shape for part in parts]

    def keep(i: int, gradient: torch.Tensor) -> None:
        each = [gradient.detach() if j == i else gradient.new_zeros(size) for j, size in enumerate(sizes)]
        for name, place in columns.items():  # the passes through the other parts add theirs
            before, found = getattr(means2d, name, None), select(torch.cat([values[..., place] for values in each]))
            setattr(means2d, name, found if before is None else before + found)

    def refuse(gradient: torch.Tensor) -> None:
        raise RuntimeError("means2d passes no gradient to the Gaussians: use Render.projected[..., :2] instead")

    if any(part.requires_grad for part in parts):
        means2d.requires_grad_().register_hook(refuse)
    for i, part in enumerate(parts):
        if part.requires_grad:
            part.register_hook(functools.partial(keep, i))
    return means2d
