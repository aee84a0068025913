"""A fit under another default type or device of torch: the same bits."""

import ast
from pathlib import Path

import pytest
import torch

import warpgs
from tests.scenes import photos, seeds
from warpgs.pipeline.train.settings import probe_seconds
from warpgs.scene import Scene

ROOT = Path(warpgs.__file__).parent
REAL = {"zeros", "ones", "full", "empty", "rand", "randn", "eye", "linspace", "tensor"}
"""Functions of torch that make numbers of the default type on the default device."""
WHOLE = {"arange", "randint", "randperm"}
"""Functions of torch that make integers on the default device."""


@pytest.fixture(params=["float64", "meta"])
def other_default(request):
    """Set another default, as a user's program may, and set the usual one again."""

    def switch():
        if request.param == "meta":
            torch.set_default_device("meta")
        else:
            torch.set_default_dtype(torch.float64)

    yield switch
    torch.set_default_device(None)
    torch.set_default_dtype(torch.float32)


def fitted(preset: str, scene: Scene, device: torch.device, **changes) -> list[torch.Tensor]:
    """The Gaussians of a short fit."""
    result = warpgs.fit(scene, preset, steps=12, split="every:4", device=device, verbose=False, **changes)
    return list(result.gaussians().tensors().values())


@pytest.mark.parametrize(
    ("preset", "changes"),
    [
        ("default", {"exposure": True, "refine_poses": True}), ("mcmc", {}), ("3dgs", {}),
        *(pytest.param(p, {}, marks=pytest.mark.slow) for p in ("quick", "paper-literal")),
    ],
)  # fmt: skip
def test_a_fit_makes_its_own_types_and_devices(other_default, device, preset, changes):
    """The second of two fits in one process, whose launches were recorded by the first."""
    scene = Scene("three Gaussians", "test", tuple(photos(6)), seeds())
    first = fitted(preset, scene, device, **changes)
    other_default()
    second = fitted(preset, scene, device, **changes)
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def test_the_step_of_a_time_budget_too(other_default, device):
    """It is made of numbers of its own."""
    other_default()
    assert probe_seconds(20, 16, device) > 0


def test_new_tensors_name_their_type_and_device():
    """In the whole package, since a fit meets only part of it."""
    for path in ROOT.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func).removeprefix("torch.") in REAL | WHOLE:
                name = ast.unparse(node.func)
                named = {k.arg for k in node.keywords}
                wanted = {"device"} | ({"dtype"} if name.removeprefix("torch.") in REAL else set())
                assert not name.startswith("torch.") or wanted <= named or None in named, f"{path}:{node.lineno}"
