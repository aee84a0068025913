"""Errors for derivatives that the kernels do not have: second derivatives, and transforms of torch.func."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import torch

from warpgs.errors import UsageError


class _NotTwice(torch.autograd.Function):
    """A gradient that depends on tensors, and raises where its own gradient is requested."""

    @staticmethod
    def forward(ctx: Any, gradient: torch.Tensor, *tensors: torch.Tensor | None) -> torch.Tensor:
        return gradient.view_as(gradient)

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> None:
        raise UsageError("the kernels have no second derivatives: leave out create_graph=True, or detach the gradient")


def keep(ctx: Any, *tensors: torch.Tensor | None) -> None:
    """Save tensors of any shape [...] for the backward pass, in which `kept` returns them."""
    ctx.save_for_backward(*tensors)
    hooked = torch._C._autograd._top_saved_tensors_default_hooks(True) is not None  # may return copies
    ctx.places = [None if t is None else (t.shape, t.dtype, t.device, None if hooked else t.data_ptr()) for t in tensors]


def kept(ctx: Any) -> tuple[Any, ...]:
    """Return the tensors [...] that `keep` saved.

    Raises:
        RuntimeError: The ``.data`` of a tensor was replaced, which autograd does not track. The gradient would be wrong, and
            with another shape or type the kernels would read and write out of bounds.
    """
    tensors = ctx.saved_tensors
    for tensor, place in zip(tensors, ctx.places, strict=True):
        if tensor is None:
            continue
        shape, dtype, device, address = place
        now = tensor.shape, tensor.dtype, tensor.device
        if now != (shape, dtype, device) or (address is not None and tensor.data_ptr() != address):
            before, after = (f"{list(s)} {t} on {d}" for s, t, d in ((shape, dtype, device), now))
            raise RuntimeError(
                f"the .data of a tensor was replaced between the forward and the backward pass ({before}, now {after}): "
                "replace it after the backward pass, or render again"
            )
    return tuple(tensors)


def first_order(backward: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap the backward method of an autograd function that has no derivative itself.

    A second derivative with respect to any saved tensor raises an error. torch's `once_differentiable` would report instead
    that the tensor was not used. Without ``create_graph``, the wrapper adds nothing to the gradients.

    Raises:
        UsageError: A gradient of a gradient is requested.
    """

    @functools.wraps(backward)
    def once(ctx: Any, *gradients: torch.Tensor | None) -> Any:
        if not torch.is_grad_enabled():
            return backward(ctx, *gradients)
        with torch.no_grad():
            found = backward(ctx, *gradients)
        sources = (*gradients, *ctx.saved_tensors)
        return tuple(None if v is None else _NotTwice.apply(v, *sources) for v in found)

    return once


class _WithoutGradient(torch.autograd.Function):
    """Values that autograd connects to their source, so that a gradient through them is an error and not silently zero."""

    @staticmethod
    def forward(ctx: Any, name: str, values: torch.Tensor, source: torch.Tensor) -> torch.Tensor:
        ctx.name = name
        return values.view_as(values)

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> None:
        raise UsageError(
            f"{ctx.name} has no gradient: use {ctx.name}.detach(), or a loss of rgb, alpha, depth or features instead"
        )


def without_gradient(name: str, values: torch.Tensor, source: torch.Tensor) -> torch.Tensor:
    """Return values of any shape [...]; a gradient through them is an error where ``source`` [...] requires gradients.

    Args:
        name: Name of the values in the error.
        values: Values that were computed from ``source`` without autograd, shape [...].
        source: Tensor that the gradient would go to, shape [...].
    """
    found: torch.Tensor = _WithoutGradient.apply(name, values, source)
    return found


def refuse_transforms() -> None:
    """Check that no transform of torch.func is active.

    Raises:
        UsageError: A transform is active.
    """
    if torch._C._are_functorch_transforms_active():
        raise UsageError(
            "rasterize does not support torch.func (grad, vmap, jacrev, jvp): use torch.autograd.grad or backward() for "
            "gradients, torch.autograd.functional.jacobian for Jacobians, and a batch of cameras [C, 4, 4] instead of vmap"
        )
