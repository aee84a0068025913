"""Parts that plug in: found by name, loaded when asked to, and never because a file names them."""

import dataclasses
import functools
import sys

import pytest
import torch

import warpgs
from tests.scenes import photos, seeds, three_gaussians
from warpgs.app.cli import main
from warpgs.errors import UsageError
from warpgs.export.base import Format, read_gaussians, write_gaussians
from warpgs.io.folder import Probe, Reader
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.model.table import Column
from warpgs.pipeline.run.folder import check_same
from warpgs.pipeline.train.loss import LOSS_TERMS, LossTerm
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.strategies.base import STRATEGIES, Strategy
from warpgs.pipeline.train.trainer import Trainer
from warpgs.pipeline.train.view_modules import VIEW_MODULES, ViewModule
from warpgs.pipeline.train.views import LearnedViews
from warpgs.plugins import Registry
from warpgs.synthetic.demo import split_spec

OWN = """
from pathlib import Path
from warpgs.pipeline.train.strategies.base import Strategy
Path(__file__).with_suffix(".ran").open("a").write("x")
class Own(Strategy):
    pass
class Other:
    pass
number = 3
"""


@pytest.fixture
def registry(registries_as_they_were) -> Registry:
    return STRATEGIES


@pytest.fixture
def own(tmp_path, monkeypatch, own_file):
    """A user's file, importable as a module too; it leaves a mark each time that it runs."""
    monkeypatch.syspath_prepend(tmp_path)
    return own_file("own_strategy.py", OWN)


def test_registered_classes_are_found_by_name(registry):
    @registry.register("zeta")
    class Zeta(Strategy):
        pass

    registry.register("alpha")(type("Alpha", (Strategy,), {}))
    assert registry.load("clone_split") is registry.find("clone_split")
    assert registry.find("zeta") is Zeta and Zeta.name == "zeta" and registry.find(Zeta) is Zeta
    assert registry.names() == sorted(registry.names())
    assert {"alpha", "zeta", "clone_split", "mcmc", "paper", "sampling"} <= set(registry.names())  # ours are not named anywhere
    assert all(registry.find(n).name == n for n in registry.names()) and {"photometric", "alpha"} <= set(LOSS_TERMS.names())


@pytest.mark.parametrize("as_file", [True, False])
def test_a_class_of_ones_own_is_loaded_once(registry, own, as_file):
    """By file or by module; found by the same name from then on, and not one of ours."""
    spec = f"{own}:Own" if as_file else "own_strategy:Own"
    cls = registry.load(spec)
    assert issubclass(cls, Strategy) and cls.name == spec and cls.__name__ == "Own"
    assert registry.load(spec) is cls is registry.find(spec) and own.with_suffix(".ran").read_text() == "x"
    assert spec not in registry.names()


@pytest.mark.parametrize(
    ("spec", "said"),
    [
        ("{own}:Other", "is not a strategy: it must be a class that derives from warpgs.Strategy"),
        ("{own}:number", "is not a strategy"),
        ("{own}:Missing", "does not exist: .* does not define Missing"),
        ("{own}x.py:Own", "cannot be imported .*there is no file"),
        ("no_such_module_of_anyone:Own", "cannot be imported .*path/to/file.py:Own"),
        ("{own.parent}/folder.py:Own", "cannot be imported"),
        (":Own", "cannot be imported"),
        (".relative:Own", "cannot be imported"),
    ],
)
def test_what_is_not_there_or_of_another_kind_is_said(registry, own, spec, said):
    (own.parent / "folder.py").mkdir()
    before = set(registry._classes)
    with pytest.raises(UsageError, match=said):
        registry.load(spec.format(own=own))
    assert set(registry._classes) == before


def test_a_file_that_fails_is_not_half_loaded(registry, own):
    """Its error is named; once it is fixed, it loads; one that cannot import its neighbour is told how, and no other."""
    own.write_text("raise RuntimeError('mine')")
    with pytest.raises(UsageError, match="RuntimeError: mine"):
        registry.load(f"{own}:Own")
    own.write_text(OWN)
    assert registry.load(f"{own}:Own").__name__ == "Own"
    (own.parent / "neighbour_probe.py").write_text("import own_neighbour\n")
    with pytest.raises(UsageError, match=r"give path/to/file\.py:Own"):
        registry.load(f"{own.parent}/neighbour_probe.py:Own")
    folder = own.parent / "sub"
    folder.mkdir()
    for name, text in (("own_neighbour", ""), ("probe", "import own_neighbour\n")):
        (folder / f"{name}.py").write_text(text)
    with pytest.raises(UsageError) as e:
        registry.load(f"{folder / 'probe.py'}:Own")
    assert "(No module named 'own_neighbour');" in str(e.value)
    assert str(e.value).endswith(f"set PYTHONPATH={folder} and give probe:Own, or use one file")


def test_unknown_names_list_those_there_are_and_none_is_imported_by_find(registry, own):
    with pytest.raises(UsageError, match=r"unknown strategy 'best'; choose one of .*clone_split.* or give module:Class"):
        registry.find("best")
    with pytest.raises(UsageError, match="int is not a strategy"):
        registry.find(int)
    for spec in (f"{own}:Own", "own_strategy:Own"):
        with pytest.raises(UsageError, match="does not load your code"):
            registry.find(spec)
    assert not own.with_suffix(".ran").exists() and "own_strategy" not in sys.modules


def test_a_stored_configuration_imports_nothing(own):
    """A strategy or a loss term of the user's own that was not loaded in this process is an error that says so."""
    plain = FitConfig().to_json()
    for changes in (
        {"strategy": f"{own}:Own"},
        {"strategy": "own_strategy:Own"},
        {"loss_terms": [{"name": f"{own}:Own"}]},
        {"loss_terms": [{"name": "own_strategy:Own"}]},
    ):
        with pytest.raises(UsageError, match="does not load your code"):
            FitConfig.from_json({**plain, **changes})
    assert not own.with_suffix(".ran").exists() and "own_strategy" not in sys.modules


def test_a_run_continues_with_the_code_that_it_began_with(tmp_path):
    same = {key: {} for key in ("fingerprint", "train", "test", "device", "scene")} | {"config": FitConfig().to_json()}
    check_same(same | {"own_code": {"mine": "a"}}, same | {"own_code": {"mine": "a"}}, tmp_path)
    check_same(same | {"own_code": {}}, same, tmp_path)  # of a version that did not record it
    for now, then in (({"mine": "a"}, {"mine": "b"}), ({"mine": "a"}, {}), ({}, {"mine": "a"})):
        with pytest.raises(UsageError, match=r"--resume: your own code \(mine\) differs from the run in"):
            check_same(same | {"own_code": now}, same | {"own_code": then}, tmp_path)


def test_settings_of_ones_own_travel_through_json(registry):
    """A strategy's own settings, an empty one too, and those of a loss term come back as they were; defaults need no saying."""

    @dataclasses.dataclass(frozen=True)
    class Settings:
        speed: float = 2.0

    @dataclasses.dataclass(frozen=True)
    class NoSettings:
        pass

    @LOSS_TERMS.register("faint")
    @dataclasses.dataclass(frozen=True)
    class Faint(LossTerm):
        weight: float = 0.5

    registry.register("fast")(type("Fast", (Strategy,), {"Config": Settings}))
    registry.register("bare")(type("Bare", (Strategy,), {"Config": NoSettings}))
    for config in (
        FitConfig(strategy="fast", strategy_config=Settings(3.0), loss_terms=(Faint(0.25), Faint())),
        FitConfig(strategy="fast"),
        FitConfig(strategy="bare"),
    ):
        assert FitConfig.from_json(config.to_json()) == config
        assert FitConfig.from_json(config.to_json()).fingerprint() == config.fingerprint()
    assert FitConfig(strategy="fast").strategy_config == Settings()
    assert FitConfig(loss_terms=(Faint(),)).fingerprint() != FitConfig(loss_terms=(Faint(0.1),)).fingerprint()


def test_an_error_in_own_code_names_its_file(demo, tmp_path, capsys):
    own = tmp_path / "mine.py"
    code = "class Mine(warpgs.Strategy):\n    def columns(self):\n        raise ValueError('my own bug')\n"
    own.write_text(f"import warpgs\n\n\n{code}")
    flags = ["--split", split_spec(8), "--preset", "3dgs", "--steps", "2", "--device", "cpu", "--strategy", f"{own}:Mine"]
    assert main(["fit", str(demo), "--out", str(tmp_path / "run"), *flags]) == 2
    said = capsys.readouterr().err
    assert "my own bug" in said and f"{own}, line 6" in said and "defect of warpgs" not in said


def of_strategy(**methods):
    return {"strategy": type("Own", (Strategy,), methods)}


def always(value):
    """A method that returns a value, whatever its arguments."""
    return lambda self, *_: value


def of_term(**methods):
    cls = LOSS_TERMS.register("own")(type("Own", (LossTerm,), methods))
    return {"loss_terms": (dataclasses.dataclass(frozen=True)(cls)(),)}


def of_module(**methods):
    learned = {"parameters": lambda self, views: {"p": torch.zeros(len(views))}, "lrs": always({"p": 0.1})}
    cls = VIEW_MODULES.register("own")(type("Own", (ViewModule,), learned | methods))
    return {"view_modules": (dataclasses.dataclass(frozen=True)(cls)(),)}


DUE = {"due": always(True)}


@pytest.mark.parametrize(
    "part, method, found, others",
    [
        *((of_strategy, "update", v, DUE) for v in (None, 3, [None], ["row"])),
        *((of_strategy, "statistics", v, {}) for v in (None, 3, {"seen": 1}, {"none": torch.zeros(60)}, {1: torch.zeros(60)})),
        (of_strategy, "statistics", {"seen": torch.zeros(59)}, {"columns": always({"seen": Column(0)})}),
        *((of_strategy, "columns", v, {}) for v in (None, {"seen": 0.0})),
        *((of_strategy, "regularisation", v, {}) for v in (1.0, torch.ones(2))),
        *((of_strategy, "lr_factors", v, {}) for v in (1.0, torch.ones(59))),
        (of_strategy, "phase", [], {}),
        *((of_term, "__call__", v, {}) for v in (None, 1.0, torch.ones(2))),
        *((of_term, "needs", v, {}) for v in (None, {"map": 1}, {"map": torch.ones(3, 3)})),
        *((of_module, "parameters", v, {}) for v in (None, {"p": 1.0}, {"p": torch.zeros(9)})),
        *((of_module, "lrs", v, {}) for v in (None, {}, {"p": "0.1"})),
        *((of_module, "values", v, {}) for v in (None, {"p": 1.0}, {"p": torch.zeros(9, 2)})),
        (of_module, "before_render", None, {}),
        *((of_module, "after_render", v, {}) for v in (None, torch.ones(3))),
        *((of_module, "regularisation", v, {}) for v in (1.0, torch.ones(2))),
    ],
)
def test_a_wrong_result_of_a_part_names_its_class_and_method(part, method, found, others, registry, device):
    """Not with an error of torch or Python from inside a step."""
    moved = found.to(device) if isinstance(found, torch.Tensor) else found
    settings = part(**{method: always(moved)} | others)
    if "strategy" in settings:
        registry.register("own")(settings["strategy"])
        settings["strategy"] = "own"
    config = FitConfig(steps=3, sh_degree=0, init=InitConfig(source="points"), cuda_graph=False, **settings)
    with pytest.raises(UsageError, match=rf"Own\.{method} must return .*; it returned .*\. Correct the class"):
        Trainer(photos(2), seeds(), config, device).advance()


@pytest.mark.parametrize("method, found", [("probe", True), ("read", None), ("read", []), ("cameras", None)])
def test_a_wrong_result_of_a_reader_or_module_after_the_fit_is_named(method, found, tmp_path):
    if method == "cameras":
        module = type("Own", (ViewModule,), {"cameras": always(found)})()
        call = functools.partial(LearnedViews([module], photos(2), torch.device("cpu")).cameras, {}, (), ())
    else:
        methods = {"probe": always(Probe("own files")), "read": always(None)} | {method: always(found)}
        call = functools.partial(warpgs.load_scene, tmp_path, reader=type("Own", (Reader,), methods))
    with pytest.raises(UsageError, match=rf"Own\.{method} must return .*; it returned"):
        call()


ARRAYS = {n: t.numpy() for n, t in three_gaussians().tensors().items()}


@pytest.mark.parametrize(
    "method, found",
    [
        *(("encode", v) for v in (None, "text", [1])),
        *(("decode", v) for v in (None, {}, ARRAYS | {"sh": [1]}, ARRAYS | {"other": ARRAYS["sh"]})),
    ],
)
def test_a_wrong_result_of_a_format_is_named(method, found, tmp_path):
    """Its bytes, and its five arrays; a file that could not be encoded is not written."""
    own = type("Own", (Format,), {"suffix": ".own", "encode": always([b"x"]), "decode": always(ARRAYS), method: always(found)})
    with pytest.raises(UsageError, match=rf"Own\.{method} must return .*; it returned"):
        write_gaussians(tmp_path / "a.own", three_gaussians(), units="file", format=own)
        read_gaussians(tmp_path / "a.own", format=own)
    assert (tmp_path / "a.own").exists() is (method == "decode")
