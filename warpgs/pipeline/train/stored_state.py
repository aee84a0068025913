"""The check of a fit's stored state, before any part of the state is used."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from warpgs.errors import DataError
from warpgs.schema import Schema, SchemaError, anything, fields, items, mapping, number, text, whole


def check_state(
    tensors: Mapping[str, torch.Tensor], plain: dict[str, Any], *, views: int, steps: int, strategy: Schema, stopping: Schema
) -> None:
    """Check the parts of a stored state that are not rows of a table; `Table.load` checks the rows.

    Args:
        tensors: Tensors by name, of any shape [...].
        plain: Plain values.
        views: Number of training views.
        steps: Number of steps of the fit.
        strategy: Schema of the strategy's own values.
        stopping: Schema of the values of early stopping.

    Raises:
        DataError: A value is missing or invalid.
    """
    state = fields({
        "step": whole(0, steps), "order": items(whole(0, views - 1)), "extent": number(above=0), "notes": items(text),
        "strategy": mapping(anything), "stopping": stopping, "stable_start": whole(0, steps), "steps": whole(1, steps),
    })  # fmt: skip
    try:
        state(plain, "")
        strategy(plain["strategy"], "strategy")
    except SchemaError as e:
        raise DataError(f"the stored state is incomplete or damaged: {e}; restore the file, or fit the scene again") from e
    try:
        torch.Generator().set_state(tensors["generator"])
    except (KeyError, TypeError, RuntimeError) as e:
        raise DataError(
            "the stored state is incomplete: generator (the state of the random numbers) is missing or damaged; restore the "
            "file, or fit the scene again"
        ) from e
