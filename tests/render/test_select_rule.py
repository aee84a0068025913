"""The fastest rule within an error, measured on the scene at hand."""

import dataclasses

import pytest
import torch

import warpgs
from tests.gaussians import camera, cloud
from warpgs.errors import UsageError
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import FASTEST_FIRST, rasterize, select_rule
from warpgs.scene import Camera

BACKGROUND = torch.tensor([1.0, 0.5, 0.0])


def cameras(device) -> list[Camera]:
    """Two views of the cloud, the second further away."""
    both = camera(50, 34, cameras=2, dtype=torch.float32, device=device)
    return [dataclasses.replace(both, viewmat=v, K=k) for v, k in zip(both.viewmat, both.K)]


@pytest.mark.parametrize(("measure", "reduce"), [("mean", torch.mean), ("max", torch.amax)])
def test_the_fastest_rule_within_the_error(device, measure, reduce):
    """At the largest error over the views a rule is chosen, just below it the next one; below float32 none is."""
    g, views = cloud(300, device=device), cameras(device)
    for number, rule in enumerate(FASTEST_FIRST):
        options = RasterizeOptions(rule=rule, background=BACKGROUND, error_bound=True)
        error = max(float(reduce(rasterize(g, c, options).error_bound)) for c in views)
        given = {"measure": measure, "options": RasterizeOptions(background=BACKGROUND)}
        assert select_rule(g, iter(views), max_error=error, **given) == (rule, error)
        if number < 2:
            slower, less = select_rule(g, views, max_error=0.99 * error, **given)
            assert slower == FASTEST_FIRST[number + 1] and 0 < less < error
        else:
            with pytest.raises(UsageError, match=rf"no rule keeps the {measure} error within .* rounding alone gives"):
                select_rule(g, views, max_error=0.99 * error, **given)


def test_haze_keeps_the_exact_rule(device):
    """Layers of 1.9/255 are seen under `exact` alone, so an error that a usual scene keeps with `fast` chooses `exact`."""
    g = cloud(300, device=device)
    haze = dataclasses.replace(
        g, log_scales=g.log_scales + 5, logit_opacities=torch.logit(torch.full_like(g.logit_opacities, 1.9 / 255))
    )
    assert warpgs.select_rule(g, cameras(device), max_error=0.05)[0] == "fast"
    assert warpgs.select_rule(haze, cameras(device), max_error=0.05)[0] == "exact"


@pytest.mark.parametrize("error", [0.0, -1.0, float("nan"), float("inf"), "0.1"])
def test_wrong_arguments(error):
    """The limit, the measure and the views are checked before a view is rendered."""
    g, views = cloud(1), cameras("cpu")
    with pytest.raises(UsageError, match="positive number"):
        select_rule(g, views, max_error=error)
    with pytest.raises(UsageError, match="measure 'median' is not one of mean, max"):
        select_rule(g, views, max_error=0.1, measure="median")
    with pytest.raises(UsageError, match="at least one camera"):
        select_rule(g, [], max_error=0.1)
    with pytest.raises(UsageError, match=r"list of cameras, not one: give \[camera\]"):
        select_rule(g, views[0], max_error=0.1)
