"""The experiment with buckets: its gradients are the product's, and what is printed says so or not."""

import math

import pytest
import torch

from bench.experiments import bucket
from bench.experiments.bucket_kernel import SIZES, make_backward
from tests.gaussians import camera, cloud
from warpgs.constants import RULES


@pytest.mark.cuda
@pytest.mark.parametrize("with_depth", [False, True])
@pytest.mark.parametrize("rule", ["gsplat", "exact", "inria"])
def test_buckets_give_the_gradients_of_chunks(rule, with_depth):
    """All slots are written, by every kernel, with what the product writes; lists of several buckets, two cameras."""
    cameras = camera(150, 90, 2, dtype=torch.float32, device="cuda:0")
    case = bucket.case_of(cloud(6000, device="cuda:0"), cameras, RULES[rule], with_depth)
    assert int((case.tiles.ranges[:, 1] - case.tiles.ranges[:, 0]).max()) > 2 * max(SIZES)
    assert len(case.variants) == 2 * len(SIZES)
    for name, errors in case.disagreements().items():
        assert all(error <= bucket.TOLERANCE for error in errors.values()), (name, errors)


@pytest.mark.cuda
def test_a_case_is_measured():
    """Every kernel has a time, and the table a line for it."""
    row = bucket.measure(
        bucket.case_of(
            cloud(500, device="cuda:0"), camera(60, 40, 1, dtype=torch.float32, device="cuda:0"), RULES["gsplat"], False
        ),
        2,
    )
    text = bucket.table([row | {"configuration": "small"}])
    assert all(t["median"] > 0 and name in text for name, t in row["gpu_us"].items())
    assert "gradients agree" in text


def test_a_gradient_that_nobody_wrote_is_a_disagreement():
    """NaN is no agreement."""
    time = {"median": 2.0, "quartiles": [1.0, 3.0], "repeats": 2}
    row = {
        "configuration": "small", "instances": 5, "chunk": 64, "state_mib": {"32": 1.0},
        "gpu_us": {"chunks of 64": time, "bucket 32": time},
        "disagreement": {"bucket 32": {"instances": math.nan, "records": 0.0}},
    }  # fmt: skip
    assert not bucket.agrees(row) and "DISAGREE" in bucket.table([row])
    row["disagreement"]["bucket 32"]["instances"] = 1e-6
    assert bucket.agrees(row) and "gradients agree" in bucket.table([row])


@pytest.mark.parametrize("size", [0, 16, 48, -32])
def test_buckets_are_whole_warps(size):
    """Other sizes are refused."""
    with pytest.raises(ValueError, match="multiple of 32"):
        make_backward(16, False, size, True)
