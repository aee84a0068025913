"""Faults that a review found: each test fails at 37ffefc1."""

import threading

import pytest
import torch
import warp as wp
from warp._src import build

from tests.gaussians import camera, cloud
from tests.kernels.test_launch import cache, doubled_sum, first_of_two, second_of_two  # noqa: F401
from warpgs.kernels import native
from warpgs.render.rasterize import rasterize

CPU = "cpu"


def named() -> str:
    second_of_two.module.mark_modified()
    return native.module_name(second_of_two.module, 1)


def clean() -> None:
    for m in (first_of_two.module, second_of_two.module):
        m.unload()
    native._LOADED.clear()
    doubled_sum.adj.deferred_static_expressions = []


def test_a_module_has_its_name_where_the_cache_has_a_folder_without_a_binary(cache):  # noqa: F811
    """As of a GPU or processor of another kind with the same home folder: the module is compiled, though `is_cached`."""
    clean()
    name = named()
    (cache / native.module_name(first_of_two.module, 1)).mkdir(parents=True)
    native.load_module(first_of_two.module, wp.get_device(CPU), 1)
    assert named() == name


def test_a_module_has_its_name_while_another_is_compiled(cache, monkeypatch):  # noqa: F811
    """In a thread of `loaded_ahead`: code was generated, and the compiler runs, for seconds."""
    clean()
    name, began, go, compile_ = named(), threading.Event(), threading.Event(), build.build_cpu

    def slow(*a, **k):
        began.set()
        go.wait(20)
        return compile_(*a, **k)

    monkeypatch.setattr(build, "build_cpu", slow)
    with native.loaded_ahead([(first_of_two.module, 1)], wp.get_device(CPU)):
        assert began.wait(20)
        now = named()
        go.set()
    assert now == name


def test_the_remedy_for_a_camera_given_as_lists_works():
    cam = camera(dtype=torch.float32)
    with pytest.raises(TypeError, match="numpy.array") as e:
        import dataclasses

        rasterize(cloud(5), dataclasses.replace(cam, K=[[50.0, 0, 32], [0, 50, 32], [0, 0, 1]]))
    assert "torch.stack" not in str(e.value) or "numpy" in str(e.value).partition("not list;")[2]
