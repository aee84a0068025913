"""Second derivatives, torch.func and torch.compile: refused by name, or right."""

import dataclasses
import itertools
import subprocess
import sys

import pytest
import torch

from tests.gaussians import camera, cloud, leaves
from warpgs.errors import UsageError
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize


def scene():
    """A small cloud, and a loss as a function of its means."""
    gaussians, cam = leaves(cloud(30)), camera(dtype=torch.float32)

    def loss(means, options=None, linear=False):
        rgb = rasterize(dataclasses.replace(gaussians, means=means), cam, options or RasterizeOptions()).rgb
        return (rgb if linear else rgb.square()).mean()

    return gaussians, loss


@pytest.mark.parametrize("most", [None, 40], ids=["whole", "chunked"])
def test_tensors_of_another_shape_in_the_backward_pass_are_refused(most):
    """Autograd does not see ``.data`` replaced: the kernels would read and write beside the tensors."""
    for name in leaves(cloud(30)).tensors():
        gaussians = leaves(cloud(30))
        render = rasterize(gaussians, camera(dtype=torch.float32), RasterizeOptions(max_instances=most))
        tensor = getattr(gaussians, name)
        tensor.data = torch.rand(7, *tensor.shape[1:])
        with pytest.raises(RuntimeError, match=r"replaced between .*\[30.*, now \[7"):
            render.rgb.sum().backward()


@pytest.mark.parametrize(
    "options",
    [RasterizeOptions(), RasterizeOptions(max_instances=40), RasterizeOptions(colors=torch.ones(30, 4))],
    ids=["blend", "chunked", "channels"],
)
def test_a_second_derivative_is_refused(options):
    """A gradient penalty raises, whichever way it is taken, and never gives zero."""
    gaussians, loss = scene()
    ways = (lambda p: p.backward(), lambda p: torch.autograd.grad(p, gaussians.means))
    for second, linear in itertools.product(
        ways, (True, False)
    ):  # a linear loss has a gradient that does not depend on the image
        value = loss(gaussians.means, options, linear)
        (v,) = torch.autograd.grad(value, gaussians.means, create_graph=True)
        with pytest.raises(UsageError, match="no second derivatives: leave out create_graph=True"):
            second(v.square().sum())


def test_create_graph_alone_changes_no_gradient():
    """A gradient that is not differentiated again is the same with and without it."""
    gaussians, loss = scene()
    plain, graph = (torch.autograd.grad(loss(gaussians.means), gaussians.means, create_graph=c)[0] for c in (False, True))
    assert torch.equal(plain, graph.detach()) and bool(plain.any()) and graph.requires_grad


def test_transforms_of_functions_are_refused():
    """torch.func cannot see into kernels; the error names the way that works."""
    gaussians, loss = scene()
    means = gaussians.means.detach()
    calls = {
        "grad": lambda: torch.func.grad(loss)(means),
        "vmap": lambda: torch.func.vmap(loss)(means.expand(2, -1, -1)),
        "jacrev": lambda: torch.func.jacrev(loss)(means),
        "jvp": lambda: torch.func.jvp(loss, (means,), (means,)),
    }
    for call in calls.values():
        with pytest.raises(UsageError, match=r"torch\.func .*use torch\.autograd.*a batch of cameras"):
            call()
    jacobian = torch.autograd.functional.jacobian(loss, means)  # the way that works
    assert torch.equal(jacobian, torch.autograd.grad(loss(gaussians.means), gaussians.means)[0])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of torch's own modules as they load
def test_compiled_functions_break_around_it():
    """torch.compile gives the same loss and gradient by a graph break; fullgraph is refused with the reason."""
    gaussians, loss = scene()
    plain = torch.autograd.grad(loss(2 * gaussians.means) * 3, gaussians.means)[0]
    compiled = torch.compile(lambda means: loss(2 * means) * 3, backend="eager")
    assert torch.equal(torch.autograd.grad(compiled(gaussians.means), gaussians.means)[0], plain)
    torch._dynamo.reset()
    whole = torch.compile(lambda means: loss(2 * means) * 3, backend="eager", fullgraph=True)
    with pytest.raises(torch._dynamo.exc.Unsupported, match="outside of compiled graphs: leave out fullgraph=True"):
        whole(gaussians.means)


@pytest.mark.slow
def test_the_compiler_is_not_loaded():
    """To load torch's compiler takes a second, which commands must not pay for it."""
    code = "import sys, warpgs.render.rasterize; sys.exit('torch._dynamo' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
