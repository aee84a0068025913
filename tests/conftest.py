"""Fixtures that every op's tests share: the devices there are, and both scalar types."""

import os
import tempfile
from pathlib import Path

import pytest
import torch

# Two processes that compile one kernel for the first time can get in each other's way: each worker has a cache of its own.
if worker := os.environ.get("PYTEST_XDIST_WORKER"):
    base = os.environ.get(
        "WARP_CACHE_PATH", Path(tempfile.gettempdir()) / f"warpgs-test-kernels-{getattr(os, 'getuid', int)()}"
    )
    os.environ["WARP_CACHE_PATH"] = str(Path(base) / worker)

DEVICES = [pytest.param("cpu")]
if torch.cuda.is_available():
    DEVICES.append(pytest.param("cuda:0", marks=pytest.mark.cuda))


def pytest_collection_modifyitems(items):
    """A test marked cuda is shown as skipped, not lost, where there is no such device."""
    if not torch.cuda.is_available():
        for item in items:
            if item.get_closest_marker("cuda"):
                item.add_marker(pytest.mark.skip(reason="no CUDA device"))


@pytest.fixture(params=DEVICES)
def device(request) -> torch.device:
    return torch.device(request.param)


@pytest.fixture(params=[torch.float32, torch.float64], ids=["float32", "float64"])
def dtype(request) -> torch.dtype:
    return request.param


@pytest.fixture(autouse=True)
def keep_thread_count():
    """Put torch's number of threads back after a test that changes it."""
    count = torch.get_num_threads()
    yield
    torch.set_num_threads(count)
