"""Ray's engine joins the cluster that is named, or starts a private one; it takes none that another user could have planted."""

import os
import stat
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from warpgs.errors import ResourceError
from warpgs.pipeline.farm.ray import RayEngine


@pytest.fixture
def started(monkeypatch):
    """What Ray is started with, by a stand-in for it."""
    found = {}
    fake = SimpleNamespace(
        is_initialized=lambda: False, init=lambda **options: found.update(options), cluster_resources=lambda: {"CPU": 4},
        remote=lambda **_: lambda work: work,
    )  # fmt: skip
    monkeypatch.setitem(sys.modules, "ray", fake)
    monkeypatch.setattr(os, "environ", {k: v for k, v in os.environ.items() if not k.startswith("RAY_")})
    return found


def test_a_cluster_of_our_own_is_private(started):
    """It never looks for one in /tmp/ray; others need its token, and cannot enter the folder of its sockets."""
    assert RayEngine("cpu", None, 1, 2).slots == 2
    folder = Path(started["_temp_dir"]).parent
    assert started["address"] == "local" and len(os.environ["RAY_AUTH_TOKEN"]) == 64 and "RAY_AUTH_MODE" not in os.environ
    assert os.name == "nt" or (stat.S_IMODE(folder.stat().st_mode) == 0o700 and folder.stat().st_uid == os.getuid())


@pytest.mark.parametrize("by_variable", [True, False])
def test_a_cluster_that_is_named_is_joined(started, by_variable):
    if by_variable:
        os.environ["RAY_ADDRESS"] = "head:6379"
    RayEngine("cpu", 1, 1, address=None if by_variable else "head:6379")
    assert started["address"] == "head:6379" and "_temp_dir" not in started and "RAY_AUTH_TOKEN" not in os.environ


def test_a_cluster_that_does_not_answer(started, monkeypatch):
    def fail(**_):
        raise ConnectionError("no route")

    monkeypatch.setattr(sys.modules["ray"], "init", fail)
    with pytest.raises(ResourceError, match="Ray at head:6379 does not answer: no route; check RAY_ADDRESS"):
        RayEngine("cpu", 1, 1, address="head:6379")
