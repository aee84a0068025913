"""The benches run; what they measure is nobody's test."""

import json

import torch

from bench.__main__ import OPS, bench


def test_every_op_gives_finite_rows():
    """Tiny sizes on the CPU: a positive time for each op, backward where there is one, and JSON that parses."""
    result = json.loads(json.dumps(bench(torch.device("cpu"), tiny=True)))
    assert {row["op"] for row in result["rows"]} == set(OPS)
    assert all(0 < row["median_ms"] < 1e5 for row in result["rows"])
    assert {r["op"] for r in result["rows"] if r["direction"] == "backward"} == {"project", "sh", "blend", "ssim"}
