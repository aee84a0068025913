"""Options and rules of wrong types or ranges: an error where they are made, which names the field."""

import math
import re

import numpy as np
import pytest
import torch

from tests.gaussians import camera, cloud
from warpgs import RasterizeOptions, Rule, rasterize
from warpgs.errors import UsageError
from warpgs.render.options import SWITCHES, WHOLE_NUMBERS


@pytest.mark.parametrize(
    "field, values",
    {
        "alpha_cut": (-1, 1, math.nan, "0.1"),
        "alpha_max": (0, 1.01, 2, math.nan, None),
        "transmittance_stop": (-0.1, 1, 2, math.nan),
        "low_pass": (-1, math.nan, math.inf, "0.1"),
        "square_sigma": (-1, math.nan, math.inf),
        "inclusive_stop": ("no", 1),
        "near": ("0.1",),
        "far": ("10",),
    }.items(),
)
def test_a_rule_checks_its_cut_offs(field, values):
    """Types and ranges; numpy's numbers are numbers, and the ends of a range are in it."""
    for value in values:
        with pytest.raises(UsageError, match=rf"Rule\.{field} must be .*{value}"):
            Rule("own", **{field: value})
    assert Rule("own", alpha_cut=0, transmittance_stop=0.0, low_pass=np.float32(0)).low_pass == 0


def test_options_check_their_types():
    """A switch takes no text, whole numbers no text, no switch and no fraction."""
    for name in SWITCHES:
        for value in ("no", "antialiased", 1, None):
            with pytest.raises(UsageError, match=f"{name} must be True or False, not {value!r}"):
                RasterizeOptions(**{name: value})
        RasterizeOptions(**{name: np.bool_(True)})
    for name in WHOLE_NUMBERS:
        for value in ("1", 1.5, True):
            with pytest.raises(UsageError, match=f"{name} must be a whole number, not {value!r}"):
                RasterizeOptions(**{name: value})
        RasterizeOptions(**{name: np.int64(8)})
    for name in ("sh_degree", "memory_budget", "capacity", "heaviest"):
        with pytest.raises(UsageError, match=f"{name} must be at least 0, not -1"):
            RasterizeOptions(**{name: -1})
    for name in ("tile_size", "heaviest"):
        with pytest.raises(UsageError, match=f"{name} must be a whole number, not None"):
            RasterizeOptions(**{name: None})
    for name in ("near", "far"):
        for value in ("1", True, [1.0]):
            with pytest.raises(UsageError, match=re.escape(f"{name} must be a number, not {value!r}")):
                RasterizeOptions(**{name: value})
    for value in ((0, 0, 16), (0.0, 0, 16, 16), "0 0 16 16", 16):
        with pytest.raises(UsageError, match=re.escape(f"window must be four whole numbers, not {value!r}")):
            RasterizeOptions(window=value)
    RasterizeOptions(near=np.float32(1), far=2, window=[np.int64(0), 0, 16, 16])


PIXELS = torch.zeros(1, 2, dtype=torch.int64)


@pytest.mark.parametrize(
    ("words", "options"),
    [
        ("unknown rule 'best': choose one of exact, balanced, fast, gsplat-1", {"rule": "best"}),
        ("tile size 12 is not one of 8, 16", {"tile_size": 12}),
        ("max_instances must be at least 1", {"max_instances": 0}),
        ("max_instances must be at least 1", {"max_instances": 10, "capacity": 100}),
        ("capacity must be at most 1,073,741,823, not 1,073,741,824", {"capacity": 2**30}),
        ("error_bound and capacity exclude each other", {"error_bound": True, "capacity": 1000}),
        ("feature_background requires features", {"feature_background": torch.zeros(8)}),
        ("pixels cannot be combined", {"pixels": PIXELS, "window": (0, 0, 16, 16)}),
        ("pixels cannot be combined", {"pixels": PIXELS, "contributions": True}),
        ("pixels cannot be combined", {"pixels": PIXELS, "capacity": 100}),
    ],
)
def test_options_out_of_range_or_together_are_refused(words, options):
    """Where they are made, not at the first render."""
    with pytest.raises(UsageError, match=words):
        RasterizeOptions(**options)


def test_a_background_is_numbers():
    """Words of the command line are not."""
    for value in ("white", ["a", "b", "c"], None.__class__):
        with pytest.raises(TypeError, match=r"background must be numbers, shape \[3\] or \[C, 3\], not"):
            rasterize(cloud(1), camera(37, 30), RasterizeOptions(background=value))


def test_a_full_device_is_not_called_a_wrong_background(monkeypatch):
    """The default background is made on the device; what fails there keeps its own error."""

    def full(*_, **__):
        raise torch.OutOfMemoryError("out of memory")

    g, cam = cloud(1), camera(37, 30)
    monkeypatch.setattr(torch.Tensor, "new_zeros", full)
    with pytest.raises(torch.OutOfMemoryError):
        rasterize(g, cam, RasterizeOptions())
