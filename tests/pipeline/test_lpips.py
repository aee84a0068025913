"""LPIPS against networks built of torch's own layers, and the one-time conversion of published weights."""

import copy
import hashlib

import numpy as np
import pytest
import torch
from safetensors import safe_open
from torch import nn

from warpgs.app.cli import main
from warpgs.errors import DataError
from warpgs.pipeline.metrics.lpips import MODES, NETS, convert_lpips, load_lpips

CHANNELS = {"vgg": (64, 128, 256, 512, 512), "alex": (64, 192, 384, 256, 256)}
TAPS = {"vgg": (3, 8, 15, 22, 29), "alex": (1, 4, 7, 9, 11)}
"""Places of the activations that are compared, in torchvision's `features`."""


def vgg16() -> nn.Sequential:
    """The convolutional half of Simonyan and Zisserman's network D."""
    layers, inputs = [], 3
    for block in ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512)):
        for outputs in block:
            layers += [nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU()]
            inputs = outputs
        layers.append(nn.MaxPool2d(2, 2))
    return nn.Sequential(*layers)


def alexnet() -> nn.Sequential:
    """The convolutional half of Krizhevsky's one-tower network."""
    return nn.Sequential(
        nn.Conv2d(3, 64, 11, stride=4, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(192, 384, 3, padding=1), nn.ReLU(),
        nn.Conv2d(384, 256, 3, padding=1), nn.ReLU(),
        nn.Conv2d(256, 256, 3, padding=1), nn.ReLU(), nn.MaxPool2d(3, 2),
    )  # fmt: skip


BUILD = {"vgg": vgg16, "alex": alexnet}


@pytest.fixture(scope="module", params=["vgg", "alex"])
def files(request, tmp_path_factory):
    """Random weights in the two published layouts: (net, features, heads, backbone file, heads file)."""
    folder = tmp_path_factory.mktemp(request.param)
    torch.manual_seed(3)
    features = BUILD[request.param]().eval()
    heads = [torch.rand(1, c, 1, 1) for c in CHANNELS[request.param]]
    state = {f"features.{k}": v for k, v in features.state_dict().items()} | {"classifier.1.weight": torch.zeros(2, 2)}
    torch.save(state, folder / "backbone.pth")
    torch.save({f"lin{i}.model.1.weight": h for i, h in enumerate(heads)}, folder / "heads.pth")
    return request.param, features, heads, folder / "backbone.pth", folder / "heads.pth"


@pytest.fixture(scope="module")
def weights(files):
    """The converted file."""
    *_, backbone, heads = files
    out = backbone.with_name("lpips.safetensors")
    convert_lpips(backbone, heads, out)
    return out


def reference(net, features, heads, a, b, mode):
    """Zhang et al. 2018, equation 1, in float64 and layer by layer."""
    features = copy.deepcopy(features).double()
    shift = torch.tensor([-0.030, -0.088, -0.188], dtype=torch.float64).view(1, 3, 1, 1)
    scale = torch.tensor([0.458, 0.448, 0.450], dtype=torch.float64).view(1, 3, 1, 1)
    x, y = (torch.from_numpy(i).double().permute(2, 0, 1)[None] for i in (a, b))
    if mode == "standard":
        x, y = 2 * x - 1, 2 * y - 1
    x, y, total = (x - shift) / scale, (y - shift) / scale, 0.0
    for i, layer in enumerate(features[: TAPS[net][-1] + 1]):
        x, y = layer(x), layer(y)
        if i in TAPS[net]:
            u, v = (t / (torch.linalg.vector_norm(t, dim=1, keepdim=True) + 1e-10) for t in (x, y))
            total += torch.einsum("nchw,c->nhw", (u - v) ** 2, heads[TAPS[net].index(i)].double().flatten()).mean()
    return float(total.detach())


ALEX = pytest.mark.parametrize("files", ["alex"], indirect=True)
"""Files of 10 MB instead of 60 where the network does not matter."""


@pytest.mark.parametrize("mode", MODES)
def test_equals_networks_of_torch_layers(files, weights, mode):
    """Random weights, both nets, both input modes."""
    net, features, heads, *_ = files
    rng = np.random.default_rng(0)
    a = rng.random((33, 38, 3), np.float32)
    b = np.clip(a + 0.2 * rng.standard_normal(a.shape, np.float32), 0, 1)
    lpips = load_lpips(weights, torch.device("cpu"))
    expected = reference(net, features, heads, a, b, mode)
    assert expected > 1e-3
    assert lpips.distance(a, b, mode) == pytest.approx(expected, rel=2e-5)
    assert lpips.distance(a, a, mode) == 0
    measured = lpips.measure(a, b)
    assert measured == {f"lpips_{net}_{m}": lpips.distance(a, b, m) for m in MODES}


@ALEX
def test_modes_differ(weights):
    """[0, 1] inputs un-rescaled are another metric than inputs in [-1, 1]."""
    rng = np.random.default_rng(1)
    a, b = rng.random((2, 40, 40, 3), np.float32)
    lpips = load_lpips(weights, torch.device("cpu"))
    assert abs(lpips.distance(a, b, "legacy") / lpips.distance(a, b, "standard") - 1) > 0.01


@ALEX
def test_images_too_small_give_no_number(weights):
    """Where the last layer would see nothing the figure is NaN, not an error in the middle of an evaluation."""
    lpips = load_lpips(weights, torch.device("cpu"))
    side = lpips.net.smallest
    small, enough = np.zeros((side - 1, 64, 3), np.float32), np.zeros((side, side, 3), np.float32)
    assert np.isnan(lpips.distance(small, small, "legacy")) and lpips.distance(enough, enough, "legacy") == 0


def test_file_says_what_it_was_made_of(files, weights):
    """Net, version and the SHA-256 of both sources; foreign tensors are left behind."""
    net, _, _, backbone, heads = files
    with safe_open(weights, "pt") as f:
        metadata, names = f.metadata(), set(f.keys())
    assert metadata["net"] == net and metadata["version"] == "unknown"
    assert metadata["backbone_sha256"] == hashlib.sha256(backbone.read_bytes()).hexdigest()
    assert metadata["heads_sha256"] == hashlib.sha256(heads.read_bytes()).hexdigest()
    assert not any("classifier" in n for n in names)
    lpips = load_lpips(weights, torch.device("cpu"))
    assert lpips.sha256 == hashlib.sha256(weights.read_bytes()).hexdigest()
    assert set(lpips.variants()) == {f"lpips_{net}_{m}" for m in MODES}
    assert "[0, 1]" in lpips.variants()[f"lpips_{net}_legacy"] and "[-1, 1]" in lpips.variants()[f"lpips_{net}_standard"]


@ALEX
def test_conversion_notes_unknown_sources(files, tmp_path):
    """Weights that are not the published ones are converted, and it is said."""
    _, _, _, backbone, heads = files
    notes = convert_lpips(backbone, heads, tmp_path / "x.safetensors")
    assert len(notes) == 3 and "not torchvision's published file" in notes[1] and "neither v0.0 nor v0.1" in notes[2]


class Evil:
    """Unpickling this would run code."""

    def __reduce__(self):
        return (open, ("/tmp/warpgs-evil", "w"))


@ALEX
def test_bad_sources_are_named(files, tmp_path):
    """Missing, foreign, truncated, of another net, not finite, or with code inside: one typed error each."""
    net, features, _, backbone, heads_file = files
    out = tmp_path / "x.safetensors"

    def refused(message, backbone=backbone, heads=heads_file):
        with pytest.raises(DataError, match=message):
            convert_lpips(backbone, heads, out)
        assert not out.exists()

    def saved(value):
        torch.save(value, tmp_path / "bad.pth")
        return tmp_path / "bad.pth"

    refused("no such file", heads=tmp_path / "nowhere.pth")
    (tmp_path / "text.pth").write_bytes(b"<html>not found</html>")
    refused("cannot be read as a torch state dict", heads=tmp_path / "text.pth")
    (tmp_path / "cut.pth").write_bytes(backbone.read_bytes()[:5000])
    refused("cannot be read as a torch state dict", backbone=tmp_path / "cut.pth")
    refused("cannot be read as a torch state dict", heads=saved({"lin0.model.1.weight": Evil()}))
    refused("holds a list", heads=saved([1, 2]))
    narrow = {f"lin{i}.model.1.weight": torch.zeros(1, 7, 1, 1) for i in range(5)}
    refused("heads of an unsupported network", heads=saved(narrow))
    refused("heads of an unsupported network", heads=backbone)
    other = {f"features.{k}": v for k, v in BUILD["alex" if net == "vgg" else "vgg"]().state_dict().items()}
    refused("features.0.weight", backbone=saved(other))
    nan = {f"features.{k}": torch.full_like(v, float("nan")) for k, v in features.state_dict().items()}
    refused("not finite", backbone=saved(nan))


@ALEX
def test_weights_are_the_same_where_files_cannot_be_mapped(files, tmp_path, monkeypatch):
    """Not every system has names for open files."""
    from safetensors.torch import load_file

    convert_lpips(files[3], files[4], tmp_path / "mapped")
    monkeypatch.setattr("warpgs.files.DESCRIPTORS", tmp_path / "none")
    convert_lpips(files[3], files[4], tmp_path / "read")
    mapped, read = (load_file(tmp_path / name) for name in ("mapped", "read"))
    assert mapped.keys() == read.keys() and all(torch.equal(t, read[n]) for n, t in mapped.items())


@ALEX
def test_packed_weights_are_refused_before_they_are_unpacked(files, tmp_path):
    """A small archive may unpack to any size, and torch copies a large pickle."""
    import zipfile

    for packing, words in (
        (zipfile.ZIP_DEFLATED, r"unpacks to [\d,]+ bytes, more than its size"),
        (zipfile.ZIP_STORED, "besides its"),
    ):
        with zipfile.ZipFile(files[4]) as old, zipfile.ZipFile(tmp_path / "heads.pth", "w", packing) as new:
            for name in old.namelist():
                new.writestr(name, old.read(name) + b" " * 2**20)
        with pytest.raises(DataError, match=f"heads.pth: cannot be read .*{words}"):
            convert_lpips(files[3], tmp_path / "heads.pth", tmp_path / "out")


def test_bad_weights_are_named(weights, tmp_path):
    """A file that this program did not convert is refused with the command that makes one."""
    from safetensors.torch import save_file

    cpu, bad = torch.device("cpu"), tmp_path / "bad.safetensors"
    with pytest.raises(DataError, match="no such file"):
        load_lpips(bad, cpu)
    bad.write_bytes(weights.read_bytes()[:-1000])
    with pytest.raises(DataError, match="warpgs convert-lpips"):
        load_lpips(bad, cpu)
    save_file({"a": torch.zeros(1)}, bad)
    with pytest.raises(DataError, match="warpgs convert-lpips"):
        load_lpips(bad, cpu)
    save_file({"a": torch.zeros(1)}, bad, {"format": "warpgs-lpips-1", "net": "vgg"})
    with pytest.raises(DataError, match="no features"):
        load_lpips(bad, cpu)


def test_headers_without_entries_and_numbers_that_are_none(tmp_path, monkeypatch):
    from safetensors.torch import save_file

    from warpgs.pipeline.metrics import lpips as lpips_weights

    bad, text = tmp_path / "bad.safetensors", b'{"__metadata__":null}   '
    bad.write_bytes(len(text).to_bytes(8, "little") + text)
    with pytest.raises(DataError, match="holds no LPIPS weights"):
        lpips_weights.read_lpips(bad)
    net = lpips_weights.Net("vgg", "small", (("conv", 0, 3, 4, 3, 1, 1), ("tap",)), 3, "")
    monkeypatch.setitem(lpips_weights.NETS, "vgg", net)
    for value in (torch.tensor(float("nan")), torch.tensor(1, dtype=torch.int32)):
        tensors = {n: value.expand(s).contiguous() for n, s in net.shapes().items()}
        save_file(tensors, bad, {"format": "warpgs-lpips-1", "net": "vgg"})
        with pytest.raises(DataError, match=r"features.0.weight is not finite float32"):
            lpips_weights.read_lpips(bad)


def test_known_nets_are_complete():
    """Both nets have five taps, and the channels of the published heads."""
    assert {n: net.channels for n, net in NETS.items()} == CHANNELS


@ALEX
def test_command(files, tmp_path, capsys):
    """`warpgs convert-lpips` writes the file and says what it is."""
    net, _, _, backbone, heads = files
    out = tmp_path / "made.safetensors"
    assert main(["convert-lpips", "--backbone", str(backbone), "--heads", str(heads), "--out", str(out)]) == 0
    assert net in capsys.readouterr().out and out.is_file()
    assert main(["convert-lpips", "--backbone", str(backbone), "--heads", str(heads), "--out", str(out)]) == 2
    assert "exists" in capsys.readouterr().err
